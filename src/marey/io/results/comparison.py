"""Writing `compare.csv`: the agreement of two motions, one row per quantity."""

import csv
from pathlib import Path

import numpy as np

from marey.io.atomic import replacing
from marey.motion.comparison import Agreement, MotionComparison

UNITS = {
    "angle": ("deg", 180 / np.pi), "rotation": ("deg", 180 / np.pi), "position": ("mm", 1e3), "distance": ("mm", 1e3),
}  # fmt: skip
"""Unit in files, and its number per radian or metre, by kind of quantity."""
SIGNED_KINDS = ("angle", "position")
"""Kinds of quantities whose differences are signed, which have limits of agreement and a correlation."""
_HEAD = (
    "quantity", "kind", "unit", "frames", "rms", "bias", "sd", "limit_low", "limit_high", "correlation",
    "within_stated_95", "shift_s", "shift_sd_s",
)  # fmt: skip
"""Columns of the file."""


def write_comparison(path: Path | str, comparison: MotionComparison) -> None:
    """Write one row per quantity; cells of unknown values are empty.

    A distance or an angle of rotation is never negative, so that its limits of agreement and its correlation have no
    meaning; these cells are empty.

    Args:
        path: The file.
        comparison: The comparison to write.
    """
    alignment = comparison.alignment
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(_HEAD)
        for row in comparison.agreements:
            shift = [_cell(alignment.shift_s, 6), _cell(alignment.shift_sd_s, 6)]
            rows.writerow([*_cells(row), *shift])


def _cells(row: Agreement) -> list[object]:
    """Return the cells of a quantity, without the shift."""
    unit, scale = UNITS[row.kind]
    signed = row.kind in SIGNED_KINDS
    low, high = row.limits if signed else (np.nan, np.nan)
    numbers = [scale * v for v in (row.rms, row.bias, row.sd, low, high)]
    ends = [row.correlation if signed else np.nan, row.within_stated]
    return [row.name, row.kind, unit, row.frames, *(_cell(v, 4) for v in numbers), *(_cell(v, 4) for v in ends)]


def _cell(value: float, digits: int) -> str:
    """Format a number; NaN is an empty cell."""
    return "" if value != value else f"{value:.{digits}f}"
