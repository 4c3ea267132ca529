"""One alias for each kind of array; the shape stands in the docstring of who uses it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]


def frozen(values: object, dtype: type = np.float64) -> NDArray:
    """Copy values into a read-only, contiguous array; one that is so already, and its own, is given as it is."""
    if isinstance(values, np.ndarray) and values.dtype == dtype and values.base is None and _finished(values):
        return values
    array: NDArray = np.array(values, dtype=dtype, order="C")
    array.setflags(write=False)
    return array


def _finished(array: NDArray) -> bool:
    return array.flags.c_contiguous and not array.flags.writeable
