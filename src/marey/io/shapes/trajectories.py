"""Trajectories of surface points on disk: trajectories.npz."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from marey.errors import FileProblem, MareyError
from marey.io.npz import ArrayRows, read_arrays, write_rows
from marey.surface.tracks.trajectories import Trajectories

_KINDS = {"frames": "<i8", "rate": "<f8", "removed": "|b1"}


def write_trajectories(path: Path | str, trajectories: Trajectories) -> None:
    """Write `trajectories.npz`, whole or not at all; numbers that depend on the frame in single precision."""
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
        FileProblem: It is missing, lacks a key, or its arrays do not fit together.
    """
    names = (
        *("frames", "rate", "position", "velocity", "acceleration", "covariance"),
        *("camera_names", "pixels", "removed"),
    )
    arrays: dict[str, Any] = read_arrays(path, names)
    try:
        return Trajectories(**{name: arrays[name] for name in names})
    except (MareyError, ValueError, TypeError) as error:
        raise FileProblem(path, f"holds no trajectories ({str(error).rstrip('.')})", "Write it again.") from error
