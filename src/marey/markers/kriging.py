"""Kriging: a field that is known in a few frames, in all the others, with the variance of what is not known."""

import numpy as np

from marey.arrays import Floats


def krige(to_known: Floats, among_known: Floats) -> tuple[Floats, Floats]:
    """Give the weights with which known values are averaged, and the variance of the result ([Matheron1963]).

    Ordinary kriging: the field's mean is unknown, the weights of a frame sum to one, and a known frame gets itself
    back. Frames known twice share their weight.

    Args:
        to_known: (F, K) semivariance between each frame and each known one: half the variance of what differs.
        among_known: (K, K) the same among the known ones.

    Returns:
        Weights (F, K) and variance (F,) in the semivariance's unit.
    """
    known = len(among_known)
    system = np.ones((known + 1, known + 1))
    system[:known, :known] = among_known
    system[known, known] = 0.0
    right = np.concatenate([to_known, np.ones((len(to_known), 1))], 1)
    solved = right @ np.linalg.pinv(system, hermitian=True)
    return solved[:, :known], np.maximum((solved * right).sum(1), 0.0)
