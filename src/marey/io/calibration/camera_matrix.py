"""Reading of the intrinsic matrix of a single camera."""

import io
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import matrix_faults
from marey.errors import FileProblem
from marey.io.documents import read_bytes, read_text
from marey.io.npz import DAMAGED_ARCHIVE, read_arrays
from marey.wording import listed

_LAYOUT = "It should contain a 3 x 3 matrix: fx 0 cx / 0 fy cy / 0 0 1, in pixels."
"""Remedy in the error messages: the expected content."""


def read_matrix(path: Path) -> Floats:
    """Read a matrix (3, 3).

    Args:
        path: An NPZ with `matrix` (or one array alone), an NPY, or text with nine numbers.

    Raises:
        FileProblem: The file cannot be read, or does not contain an intrinsic matrix.
    """
    try:
        if path.suffix.lower() == ".npz":
            arrays = read_arrays(path)
            if "matrix" not in arrays and len(arrays) != 1:
                raise FileProblem(path, f"has no array called matrix, but {listed(arrays, none='none')}", _LAYOUT)
            matrix = arrays.get("matrix", next(iter(arrays.values())))
        elif path.suffix.lower() == ".npy":
            matrix = np.load(io.BytesIO(read_bytes(path, _LAYOUT)), allow_pickle=False)
        else:
            text = read_text(path, _LAYOUT).replace(",", " ").replace(";", " ")
            matrix = np.array([float(part) for part in text.split()])
        if matrix.dtype.kind not in "fiu":
            raise ValueError(f"it holds {matrix.dtype} instead of numbers")
        matrix = np.asarray(matrix, float)
    except DAMAGED_ARCHIVE as error:
        raise FileProblem(path, f"cannot be read as a matrix ({error})", _LAYOUT) from error
    if matrix.size != 9:
        raise FileProblem(path, f"has an array of shape {matrix.shape}", _LAYOUT)
    matrix = matrix.reshape(3, 3)
    faults = matrix_faults(matrix)
    if faults:
        raise FileProblem(path, faults[0], _LAYOUT)
    return matrix
