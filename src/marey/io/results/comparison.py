"""compare.csv: how far two motions agree, a row a quantity."""

import csv
from pathlib import Path

import numpy as np

from marey.io.atomic import replacing
from marey.motion.comparison import Agreement, MotionComparison

UNITS = {"angle": ("deg", 180 / np.pi), "turn": ("deg", 180 / np.pi), "place": ("mm", 1e3), "distance": ("mm", 1e3)}
"""Unit in files, and what it is of the own one, by kind of quantity."""
SIGNED_KINDS = ("angle", "place")
"""Kinds of quantities whose differences have a sign, so that they have limits of agreement."""
_HEAD = (
    "quantity", "kind", "unit", "frames", "rms", "bias", "sd", "limit_low", "limit_high", "correlation",
    "within_stated_95", "shift_s", "shift_sd_s",
)  # fmt: skip


def write_comparison(path: Path | str, comparison: MotionComparison) -> None:
    """Write a row a quantity; a cell without an answer is empty.

    A distance or turn is never below zero: limits and correlation say nothing of it and stay empty.

    Args:
        path: The file.
        comparison: What to write.
    """
    alignment = comparison.alignment
    with replacing(path) as beside, beside.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(_HEAD)
        for row in comparison.agreements:
            shift = [_cell(alignment.shift_s, 6), _cell(alignment.shift_sd_s, 6)]
            rows.writerow([*_cells(row), *shift])


def _cells(row: Agreement) -> list[object]:
    unit, scale = UNITS[row.kind]
    signed = row.kind in SIGNED_KINDS
    low, high = row.limits if signed else (np.nan, np.nan)
    numbers = [scale * v for v in (row.rms, row.bias, row.sd, low, high)]
    ends = [row.correlation if signed else np.nan, row.within_stated]
    return [row.name, row.kind, unit, row.frames, *(_cell(v, 4) for v in numbers), *(_cell(v, 4) for v in ends)]


def _cell(value: float, digits: int) -> str:
    return "" if value != value else f"{value:.{digits}f}"
