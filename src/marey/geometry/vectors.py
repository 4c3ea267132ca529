"""Stacks of vectors: their directions, and their products with stacks of matrices."""

import numpy as np

from marey.arrays import Floats

SHORTEST = 1e-12
"""Length below which a vector has no direction, in the vector's unit; a guard against a division by zero."""


def unit(vector: Floats) -> Floats:
    """Return vectors (..., 3) scaled to length one."""
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def unit_or_zero(vector: Floats) -> Floats:
    """Return vectors (..., 3) scaled to length one; those shorter than `SHORTEST` are divided by it instead."""
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), SHORTEST))


def products(matrices: Floats, vectors: Floats) -> Floats:
    """Multiply matrices (..., M, N) with vectors (..., N), one by one: (..., M)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])
