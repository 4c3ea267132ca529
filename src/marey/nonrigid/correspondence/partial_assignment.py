"""Partners between two sets, each with at most one: the best assignment, and how sure each pair of it is."""

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from marey.arrays import Floats, Integers

_ROUNDS = 100
_STILL = 1e-4
_SURE = 60.0
"""Scores beyond this are no surer than this [natural logarithm]."""


def best_pairs(score: Floats) -> tuple[Integers, Integers]:
    """Choose pairs of the greatest total score; who would lower it stays alone.

    Args:
        score: (P, Q) logarithm of how much more probable a pair makes what was seen than two that are alone.

    Returns:
        Rows and columns of the pairs, each (n,).
    """
    rows, columns = linear_sum_assignment(-np.maximum(score, 0))
    good = score[rows, columns] > 0
    return rows[good], columns[good]


def pair_probabilities(score: Floats) -> Floats:
    """Give the probability (P, Q) of each pair, over all assignments, by belief propagation ([Chertkov2010]).

    Args:
        score: (P, Q) as for `best_pairs`.
    """
    score = np.clip(score, -_SURE, _SURE)
    from_rows, from_columns = np.zeros_like(score), np.zeros_like(score)
    for _ in range(_ROUNDS):
        before = from_rows
        from_rows = -_others(score + from_columns, 1)
        from_columns = -_others(score + from_rows, 0)
        # Half of the step: two equal columns would otherwise swing for ever.
        from_rows = (from_rows + before) / 2
        if np.max(np.abs(from_rows - before), initial=0) < _STILL:
            break
    return np.asarray(expit(score + from_rows + from_columns))


def _others(messages: Floats, axis: int) -> Floats:
    """Give log(1 + sum of the exponentials of all others along an axis)."""
    top = np.maximum(messages.max(axis=axis, keepdims=True), 0)
    share = np.exp(messages - top)
    rest = np.exp(-top) + share.sum(axis=axis, keepdims=True) - share
    return np.asarray(top + np.log(np.maximum(rest, 1e-300)))
