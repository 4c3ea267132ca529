"""Lines between points that lie near each other: they help the eye to see a surface."""

import numpy as np

from marey.arrays import Floats, Integers

_TOUCHING = 1e-9
"""Share by which a point must lie inside of a ball."""


def near_lines(shape: Floats) -> Integers:
    """Join points between which no other one lies: none is in the ball about their middle ([Gabriel1969]).

    Args:
        shape: (3, P) for example the mean shape; NaN for points without a place.

    Returns:
        (E, 2) pairs of points, none twice; they hold all points together.
    """
    known = np.flatnonzero(np.isfinite(shape).all(0))
    points = shape[:, known].T
    square = ((points[:, None] - points) ** 2).sum(-1)
    pairs = []
    for a in range(len(known)):
        later = np.arange(a + 1, len(known))
        # A point c lies in the ball over a and b where ac2 + bc2 < ab2; a and b themselves lie on it.
        blocked = (square[a] + square[later] < square[a, later][:, None] * (1 - _TOUCHING)).any(1)
        pairs += [(known[a], known[b]) for b in later[~blocked]]
    return np.array(pairs, np.int64).reshape(-1, 2)
