"""Reading and writing of the trajectories of surface points: trajectories.npz."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from marey.io.npz import ArrayRows, consistent_arrays, read_arrays, write_rows
from marey.surface.tracks.trajectories import Trajectories

_KINDS = {"frames": "<i8", "rate": "<f8", "removed": "|b1"}
"""NumPy types of the arrays that are not in single precision."""


def write_trajectories(path: Path | str, trajectories: Trajectories) -> None:
    """Write `trajectories.npz`, with values per frame in single precision.

    An interrupted write leaves no partial file.
    """
    arrays = trajectories.arrays()
    names = np.array(arrays.pop("camera_names"), str)
    rows: list[ArrayRows] = [
        (name, _pieces(values), np.dtype(_KINDS.get(name, "<f4")), values.shape) for name, values in arrays.items()
    ]
    write_rows(path, [*rows, ("camera_names", [names], names.dtype, names.shape)])


def _pieces(values: np.ndarray) -> Iterator[np.ndarray]:
    return iter([values]) if values.ndim < 2 else (values[f : f + 1] for f in range(len(values)))


def read_trajectories(path: Path | str) -> Trajectories:
    """Read `trajectories.npz`.

    Args:
        path: The file.

    Raises:
        FileProblem: It is missing, has no array of a required name, or its array shapes do not agree.
    """
    names = (
        *("frames", "rate", "position", "velocity", "acceleration", "covariance"),
        *("camera_names", "pixels", "removed"),
    )
    arrays: dict[str, Any] = read_arrays(path, names, texts=("camera_names",))
    with consistent_arrays(path, "Give a trajectories.npz as `marey surface` writes it."):
        return Trajectories(**{name: arrays[name] for name in names})
