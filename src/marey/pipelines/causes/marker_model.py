"""Causes of a large distance between the markers and an OpenSim model, each tested by trying its repair."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.jointed_body import JointedBody
from marey.errors import MareyError
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.units import METRES
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.inverse_kinematics import InverseKinematics, inverse_kinematics
from marey.markers.preprocessing.posture_repairs import side_pairs
from marey.pipelines.causes.marker_postures import LARGEST_LEAN_DEG
from marey.pipelines.verdict import VerdictReason

_TRIED_FRAMES = 4
"""Number of frames, spread over the trial, in which each repair is tried. Chosen by hand."""
_SUSPECTS = 8
"""Number of markers, those farthest from the model, of which each pair is exchanged for a trial: in six planted
exchanges of `gait` both were among the six farthest, unless the exchange changed the fit by less than 1 mm."""
_LARGEST_FIT_RATIO = 0.7
"""With a repair, the distance from the model is below this ratio of that without. On frames 0 to 120 of `gait`/walk,
planted units, mirror images, exchanged sides and pairs give 0.62 at most, and no repair of the sound trial passes. Held
out, on `gait`/static: 0.02 at most, and none passes."""
_LEAST_FIT_GAIN_M = 0.005
"""And smaller by at least this much (RMS) [m]. Chosen by hand: about the usual motion of the skin."""
_MM = 1e3
"""Millimetres in a metre."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _TriedRepair:
    points: Floats
    """(F, M, 3) repaired positions of the markers [m]."""
    what: str
    """The cause, as the start of a sentence."""
    remedy: str


def model_reasons(model: JointedBody, markers: MarkerTrajectories, *, y_up: bool) -> tuple[VerdictReason, ...]:
    """Explain why the markers are far from the model.

    Args:
        model: The model.
        markers: The trial, in frames in which markers are visible.
        y_up: Whether Y is the vertical axis of the trial; otherwise Z is.

    Returns:
        The cause whose repair fits best, if it explains the distance.
    """
    few = _few_frames(markers, y_up=y_up)
    own = _fitted(model, few)
    if own is None:
        return ()
    best, after = None, np.inf
    for repair in (*_whole_repairs(few), *_exchanges(few, own)):
        found = _fitted(model, replace(few, points=repair.points))
        if found is not None and _rms_m(found) < after:
            best, after = repair, _rms_m(found)
    before = _rms_m(own)
    if best is None or after > _LARGEST_FIT_RATIO * before or before - after < _LEAST_FIT_GAIN_M:
        return ()
    achieved = f"corrected, the markers are {_MM * after:.0f} mm instead of {_MM * before:.0f} mm from the model (RMS)"
    return (VerdictReason.failure(f"{best.what}: {achieved}.", best.remedy),)


def lying_reasons(pelvis: Floats, *, y_up: bool) -> Iterator[VerdictReason]:
    """Name a model that lies: the vertical axis of the trial may be another one.

    Args:
        pelvis: (F, 3, 3) rotation of the model's pelvis in the axes of the trial; NaN without a result.
        y_up: Whether Y is the vertical axis of the trial; otherwise Z is.

    Yields:
        At most one reason.
    """
    upright = pelvis[np.isfinite(pelvis).all((1, 2)), 1 if y_up else 2, 1]
    if not len(upright):
        return
    lean = float(np.degrees(np.arccos(np.clip(np.median(upright), -1, 1))))
    if lean > LARGEST_LEAN_DEG:
        what = (
            f"The pelvis of the model is {lean:.0f} degrees from upright (median): unless the person lay, the vertical "
            f"axis of the trial is not {'Y' if y_up else 'Z'}, and the coordinates of the pelvis are wrong."
        )
        yield VerdictReason.limit(what, "Export the trial with Y up in a TRC, or with its axes stated in a C3D.")


def _few_frames(markers: MarkerTrajectories, *, y_up: bool) -> MarkerTrajectories:
    """Return some frames, in the axes of the model's ground."""
    chosen = np.unique(np.linspace(0, len(markers) - 1, min(_TRIED_FRAMES, len(markers))).astype(int))
    turn = np.eye(3) if y_up else OPENSIM_FROM_WORLD
    return replace(
        markers, points=markers.points[chosen] @ turn.T, filled=markers.filled[chosen],
        residuals=markers.residuals[chosen],
    )  # fmt: skip


def _fitted(model: JointedBody, markers: MarkerTrajectories) -> InverseKinematics | None:
    """Fit the model to a few frames, all markers with equal weights."""
    try:
        found = inverse_kinematics(model, None, markers)
    except MareyError:
        return None
    return found if np.isfinite(found.rms).any() else None


def _rms_m(found: InverseKinematics) -> float:
    return float(np.sqrt(np.nanmean(found.rms**2)))


def _whole_repairs(markers: MarkerTrajectories) -> Iterator[_TriedRepair]:
    """Yield the repairs that concern all markers."""
    points = markers.points
    for factor in sorted({a / b for a in METRES.values() for b in METRES.values()} - {1.0}):
        what = f"The unit of the trial is wrong by a factor of {1 / factor:g}"
        yield _TriedRepair(points=points * factor, what=what, remedy="Correct the unit (--unit).")
    remedy = "Correct the sign of one axis in the program that exported the file."
    yield _TriedRepair(points=points * np.array([1.0, 1.0, -1.0]), what="The trial is a mirror image", remedy=remedy)
    partner = side_pairs(markers.labels)
    if partner:
        order = [markers.labels.index(partner.get(label, label)) for label in markers.labels]
        what, remedy = "Left and right labels are exchanged", "Exchange the labels of the two sides."
        yield _TriedRepair(points=points[:, order], what=what, remedy=remedy)


def _exchanges(markers: MarkerTrajectories, own: InverseKinematics) -> Iterator[_TriedRepair]:
    """Yield the exchanges of two of the markers that are farthest from the model."""
    squares = (own.residuals**2).sum(-1)
    far = np.where(np.isfinite(squares), squares, 0.0).sum(0)
    suspects = [own.marker_labels[int(m)] for m in np.argsort(-far)[:_SUSPECTS]]
    for first, second in combinations(suspects, 2):
        order = list(range(len(markers.labels)))
        a, b = markers.labels.index(first), markers.labels.index(second)
        order[a], order[b] = b, a
        yield _TriedRepair(
            points=markers.points[:, order], what=f"The labels {first} and {second} are exchanged",
            remedy="Exchange the two labels in the trial.",
        )  # fmt: skip
