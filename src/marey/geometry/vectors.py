"""Stacks of vectors: their directions, and their products with stacks of matrices."""

import numpy as np

from marey.arrays import Floats


def unit(vector: Floats) -> Floats:
    """Return vectors (..., 3) scaled to length one."""
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def products(matrices: Floats, vectors: Floats) -> Floats:
    """Multiply matrices (..., M, N) with vectors (..., N), one by one: (..., M)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])
