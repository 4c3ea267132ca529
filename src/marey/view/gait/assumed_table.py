"""The table of measurements of a person that are assumed, and of what they contribute to joint angles, for a page."""

from collections.abc import Sequence

import numpy as np

from marey.markers.data.person import AssumedMeasurement
from marey.markers.kinematics.calibration_offsets import AngleOffset
from marey.view.pages.curves import NumberTable
from marey.view.pages.problems import readable

_LEAST_DEG = 0.05
"""Standard deviation of an angle below which the table leaves it out [degrees]; it would be shown as 0.0."""
_LEGEND = (
    "Nothing states these measurements. An error of one is constant over the trial; the standard deviation that it "
    "leaves in each angle (median over the frames) is part of the intervals. assumed.csv contains all angles."
)
"""What the table shows."""


def assumed_table(offsets: Sequence[AngleOffset]) -> list[NumberTable]:
    """Return the table of the assumed measurements; none without any.

    Args:
        offsets: What the measurements contribute to the standard deviations of the angles.
    """
    sizes: dict[str, AssumedMeasurement] = {row.measurement.name: row.measurement for row in offsets}
    if not sizes:
        return []
    head = ("measurement", "mm", "standard deviation, mm", "source", "standard deviation of angles, °")
    rows = [
        [readable(name), f"{1e3 * size.value_m:.0f}", f"{1e3 * size.sd_m:.1f}", size.source, _angles(name, offsets)]
        for name, size in sizes.items()
    ]
    return [
        NumberTable(title="Assumed measurements", head=head, rows=rows, legend=_LEGEND, text_columns=(0, 3, 4))
    ]  # fmt: skip


def _angles(name: str, offsets: Sequence[AngleOffset]) -> str:
    own = [row for row in offsets if row.measurement.name == name and np.degrees(row.sd) >= _LEAST_DEG]
    own.sort(key=lambda row: -row.sd)
    return ", ".join(f"{readable(row.angle)} {np.degrees(row.sd):.1f}" for row in own)
