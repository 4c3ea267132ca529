"""One alias for each kind of array; the shape is given in the docstring of each argument or field.

Besides, read-only copies of arrays, the array fields of a record, and the runs of true elements in a mask.
"""

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]


def frozen(values: object, dtype: type = np.float64) -> NDArray[Any]:
    """Copy values into a read-only, contiguous array; one that is so already, and its own, is given as it is."""
    if isinstance(values, np.ndarray) and values.dtype == dtype and values.base is None and _finished(values):
        return values
    array: NDArray[Any] = np.array(values, dtype=dtype, order="C")
    array.setflags(write=False)
    return array


def freeze_fields(record: object, *names: str, dtype: type = np.float64) -> None:
    """Replace array fields of a frozen record by read-only copies; for use in `__post_init__`.

    Args:
        record: A frozen dataclass.
        names: Fields that hold arrays, or what NumPy converts to one. A field that is None stays None.
        dtype: Element type of the copies.
    """
    for name in names:
        values = getattr(record, name)
        if values is not None:
            object.__setattr__(record, name, frozen(values, dtype))


def fields_of(record: Any) -> dict[str, np.ndarray]:
    """Return all fields of a dataclass as arrays by name."""
    return {field.name: np.asarray(getattr(record, field.name)) for field in fields(record)}


def true_runs(mask: Mask) -> list[tuple[int, int]]:
    """List the runs of true elements of a mask (F,) as pairs (first index, index after the last)."""
    edges = np.diff(np.concatenate([[0], np.asarray(mask, np.int8), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def _finished(array: NDArray[Any]) -> bool:
    return array.flags.c_contiguous and not array.flags.writeable
