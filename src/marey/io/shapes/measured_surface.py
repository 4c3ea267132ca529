"""Reading and writing of measured surfaces: surface.npz, and coloured point clouds as PLY."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from marey.io.npz import ArrayRows, consistent_arrays, read_arrays, write_rows
from marey.io.shapes.point_cloud import write_point_cloud
from marey.surface.points.measured import MeasuredPoints, shapes

_KINDS = {"frame": "<i8", "colour": "|u1"}
"""NumPy types of the arrays that are not in single precision.

The resolution of single precision is 0.1 µm at 1 m, and 0.0001 px at 1000 px."""


def write_surface(path: Path | str, parts: Sequence[MeasuredPoints], camera_names: Sequence[str]) -> None:
    """Write `surface.npz`; only one part at a time is held in memory.

    Args:
        path: The file.
        parts: The points, preferably one part per frame; iterated several times.
        camera_names: Names of the cameras, also needed when there are no parts.
    """
    count = sum(len(part) for part in parts)
    rows: list[ArrayRows] = [
        (name, _pieces(parts, name), np.dtype(_KINDS.get(name, "<f4")), (count, *shape))
        for name, shape in shapes(len(camera_names)).items()
    ]
    names = np.array(camera_names, str)
    write_rows(path, [*rows, ("camera_names", [names], names.dtype, names.shape)])


def _pieces(parts: Sequence[MeasuredPoints], name: str) -> Iterator[np.ndarray]:
    return (getattr(part, name) for part in parts)


def read_surface(path: Path | str) -> MeasuredPoints:
    """Read `surface.npz`.

    Args:
        path: The file.

    Raises:
        FileProblem: It is missing, has no array of a required name, or its array shapes do not agree.
    """
    names = (*shapes(0), "camera_names")
    arrays: dict[str, Any] = read_arrays(path, names, texts=("camera_names",))
    with consistent_arrays(path, "Give a surface.npz as `marey surface` writes it."):
        return MeasuredPoints(**{name: arrays[name] for name in names})


def write_ply(path: Path | str, points: MeasuredPoints) -> None:
    """Write points with their colours as binary PLY, in metres.

    Args:
        path: The file.
        points: The points; those that are NaN are omitted.
    """
    write_point_cloud(path, points.points, points.colour, comment="metres, world axes")
