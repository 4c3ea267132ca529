"""`contours.json`: outlines of a knee's structures in the slices of a volume, as `marey knee outline` keeps them."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.knee.outlines.contours import AXES, Contour, slice_count
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import VoxelGrid

_SAME_MM = 0.01
_DECIMALS = 3
_FEWEST = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class OutlinedVolume:
    """Outlines, and the volume in which they lie."""

    contours: tuple[Contour, ...]
    grid: VoxelGrid
    volume: str
    """The volume's file or folder as it was named."""


def write_contours(path: Path | str, contours: Sequence[Contour], grid: VoxelGrid, volume: str) -> None:
    """Write outlines with the grid of the volume they belong to; whole or not at all.

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
        FileProblem: The file is missing or damaged, or an outline is of an unknown structure, outside the volume or
            is none.
    """
    path = Path(path)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        grid = VoxelGrid(shape=_shape(table["shape"]), lps_from_voxel=_numbers(table["lps_from_voxel"], (4, 4)))
        entries, volume = list(table["contours"]), str(table.get("volume", ""))
    except FileNotFoundError as error:
        raise FileProblem(path, "is not there") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        said = f"{type(error).__name__}: {error}"
        raise FileProblem(path, f"holds no outlines ({said})", "`marey knee outline` writes such files.") from error
    contours = tuple(_contour(path, number, entry, grid) for number, entry in enumerate(entries, 1))
    return OutlinedVolume(contours=contours, grid=grid, volume=volume)


def same_grid(first: VoxelGrid, second: VoxelGrid) -> bool:
    """Tell whether two volumes have the same voxels in the same places."""
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
    except (ValueError, KeyError, TypeError) as error:
        said = f"{type(error).__name__}: {error}"
        raise FileProblem(path, f"has an outline, number {number}, that cannot be read ({said})") from error
    if structure not in LABELS:
        raise FileProblem(path, f"outlines a '{structure}', which is unknown", f"Known are {', '.join(LABELS)}.")
    if axis not in AXES or not 0 <= index < slice_count(grid, axis):
        raise FileProblem(path, f"has an outline in slice {index} across {axis}, which the volume does not have")
    if len(outline) < _FEWEST:
        raise FileProblem(
            path, f"has an outline, number {number}, of {len(outline)} points", "Take it out of the file."
        )
    return Contour(structure=structure, axis=axis, index=index, anchors=anchors, outline=outline)


def _shape(values: Any) -> tuple[int, int, int]:
    k, j, i = (int(value) for value in values)
    if min(k, j, i) < 1:
        raise ValueError("a shape without voxels")
    return k, j, i


def _numbers(values: Any, shape: tuple[int, int]) -> Floats:
    array = np.array(values, dtype=float).reshape(shape)
    if not np.isfinite(array).all():
        raise ValueError("values that are no numbers")
    return array
