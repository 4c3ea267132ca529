"""`contours.json`: outlines of a knee's structures in the slices of a volume, written by `marey knee outline`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.documents import read_json_table
from marey.knee.outlines.contours import AXES, Contour, slice_count
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import VoxelGrid

_SAME_MM = 0.01
"""Two grids are the same if their corners differ by less than this distance [mm]; chosen by hand, far below a voxel."""
_DECIMALS = 3
"""Decimal places of the coordinates in the file [0.001 voxel]; chosen by hand."""
_FEWEST_POINTS = 3
"""Smallest number of points of an outline, a triangle."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutlinedVolume:
    """Outlines with the grid of their volume."""

    contours: tuple[Contour, ...]
    grid: VoxelGrid
    volume: str
    """The volume's file or folder, as given by the user."""


def write_contours(path: Path | str, contours: Sequence[Contour], grid: VoxelGrid, volume: str) -> None:
    """Write outlines with the grid of their volume; an interrupted write leaves no partial file.

    Raises:
        FileProblem: The folder cannot be written to.
    """
    table = {
        "volume": volume,
        "shape": list(grid.shape),
        "lps_from_voxel": grid.lps_from_voxel.tolist(),
        "contours": [_as_table(contour) for contour in contours],
    }
    with replacing(path) as beside:
        beside.write_text(json.dumps(table) + "\n", encoding="utf-8")


def read_contours(path: Path | str) -> OutlinedVolume:
    """Read outlines.

    Raises:
        FileProblem: The file is missing or damaged, or an outline has an unknown structure, a slice outside the
            volume, or fewer than three points.
    """
    path = Path(path)
    table = read_json_table(path, "`marey knee outline` writes such files.")
    try:
        grid = VoxelGrid(shape=_shape(table["shape"]), lps_from_voxel=_numbers(table["lps_from_voxel"], (4, 4)))
        entries, volume = list(table["contours"]), str(table.get("volume", ""))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise FileProblem(
            path, f"cannot be read as outlines ({reason})", "`marey knee outline` writes such files."
        ) from error
    contours = tuple(_contour(path, number, entry, grid) for number, entry in enumerate(entries, 1))
    return OutlinedVolume(contours=contours, grid=grid, volume=volume)


def same_grid(first: VoxelGrid, second: VoxelGrid) -> bool:
    """Return whether two grids have the same voxels at the same positions."""
    if first.shape != second.shape:
        return False
    k, j, i = first.shape
    corners = np.array([[0, 0, 0], [i - 1, 0, 0], [0, j - 1, 0], [0, 0, k - 1]], dtype=float)
    return bool(np.abs(first.lps(corners) - second.lps(corners)).max() < _SAME_MM)


def _as_table(contour: Contour) -> dict[str, object]:
    return {
        "structure": contour.structure,
        "axis": contour.axis,
        "slice": contour.index,
        "anchors": np.round(contour.anchors, _DECIMALS).tolist(),
        "outline": np.round(contour.outline, _DECIMALS).tolist(),
    }


def _contour(path: Path, number: int, entry: Any, grid: VoxelGrid) -> Contour:
    try:
        structure, axis, index = entry["structure"], entry["axis"], int(entry["slice"])
        anchors, outline = _numbers(entry["anchors"], (-1, 2)), _numbers(entry["outline"], (-1, 2))
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise FileProblem(
            path, f"has an outline, number {number}, that cannot be read ({reason})", "Remove it from the file."
        ) from error
    if not isinstance(structure, str) or structure not in LABELS:
        raise FileProblem(
            path, f"has an outline of the unknown structure '{structure}'", f"Known structures: {', '.join(LABELS)}."
        )
    if axis not in AXES or not 0 <= index < slice_count(grid, axis):
        raise FileProblem(
            path, f"has an outline in slice {index} across {axis}, which does not exist in the volume",
            "Remove it from the file.",
        )  # fmt: skip
    if len(outline) < _FEWEST_POINTS:
        raise FileProblem(
            path, f"has an outline, number {number}, of only {len(outline)} points", "Remove it from the file."
        )
    return Contour(structure=structure, axis=axis, index=index, anchors=anchors, outline=outline)


def _shape(values: Any) -> tuple[int, int, int]:
    k, j, i = (int(value) for value in values)
    if min(k, j, i) < 1:
        raise ValueError("the shape has no voxels")
    return k, j, i


def _numbers(values: Any, shape: tuple[int, int]) -> Floats:
    array = np.array(values, dtype=float).reshape(shape)
    if not np.isfinite(array).all():
        raise ValueError("some values are not finite")
    return array
