"""Joint angles beside those that another program wrote into the file: a table, and curves over each other."""

from collections.abc import Sequence

import numpy as np

from marey.markers.data.given_angles import GivenAngles
from marey.markers.kinematics.given_agreement import GivenAgreement
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.view.pages.curves import COLOURS, CurvePlot, NumberTable, PlotGroup, Trace
from marey.view.pages.problems import readable

_LEGEND = (
    "Ours minus the angle in the file, with the sign that the table states. Positive are flexion, adduction, "
    "inversion, dorsiflexion and internal rotation, and of the pelvis anterior tilt, right side down and rotation to "
    "the left. The bias is a difference of definitions, and neither is the truth (that of the pelvis' rotation is the "
    "direction from which each program counts); the spread is the standard deviation of the difference about the "
    "bias. A foot with two markers hardly determines its inversion."
)
"""What the table shows."""


def given_angle_table(rows: Sequence[GivenAgreement]) -> list[NumberTable]:
    """Return the table of the agreements; none without any.

    Args:
        rows: The agreements.
    """
    if not rows:
        return []
    cells = [
        [
            readable(row.agreement.name), _component(row), f"{row.agreement.frames}",
            _degrees(row.agreement.bias), _degrees(row.agreement.sd),
            "" if np.isnan(row.agreement.correlation) else f"{row.agreement.correlation:.3f}",
        ]
        for row in rows
    ]  # fmt: skip
    head = ("angle", "in the file", "frames", "bias °", "spread °", "correlation")
    return [NumberTable(title="Angles in the file", head=head, rows=cells, legend=_LEGEND, text_columns=(0, 1))]


def _component(row: GivenAgreement) -> str:
    return f"{row.label} {'-' if row.sign < 0 else ''}{row.component}"


def _degrees(value: float) -> str:
    return "" if np.isnan(value) else f"{np.degrees(value):.2f}"


def given_angle_plots(
    joints: JointKinematics, given: GivenAngles | None, rows: Sequence[GivenAgreement]
) -> list[PlotGroup]:  # fmt: skip
    """Return the curves of the angles that are in both; none without any.

    Args:
        joints: Our angles.
        given: The angles of the file.
        rows: The agreements, which name the pairs.
    """
    if given is None or not rows:
        return []
    plots = []
    for row in rows:
        own = joints.angle_names.index(row.agreement.name)
        theirs = row.sign * given.values[:, given.labels.index(row.label), "xyz".index(row.component)]
        plots.append(
            CurvePlot(
                title=f"{readable(row.agreement.name)}: {_component(row)}",
                curves=[
                    Trace(label="in the file", colour=COLOURS[1], values=np.degrees(theirs)),
                    Trace(
                        label="ours", colour=COLOURS[0], values=np.degrees(joints.angles[:, own]),
                        sd=np.degrees(joints.angles_sd[:, own]),
                    ),
                ],
            )
        )  # fmt: skip
    keys = [("ours", COLOURS[0]), ("in the file", COLOURS[1])]
    legend = "Degrees over time [s]; the band is our 95 % interval, which does not include differences of definitions."
    return [PlotGroup(title="Beside the angles in the file", plots=plots, keys=keys, legend=legend)]
