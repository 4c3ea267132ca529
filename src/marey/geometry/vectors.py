"""Vectors of space."""

import numpy as np

from marey.arrays import Floats


def unit(vector: Floats) -> Floats:
    """Return vectors (..., 3) scaled to length one."""
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))
