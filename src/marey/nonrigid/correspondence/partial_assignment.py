"""Assignment between two sets with at most one partner each, and the probabilities of the pairs."""

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from marey.arrays import Floats, Integers

_ROUNDS = 100
"""Largest number of rounds of belief propagation; a limit on time."""
_TOLERANCE = 1e-4
"""Rounds end when no message changes by more than this [natural logarithm]; a numerical tolerance."""
_LARGEST_SCORE = 60.0
"""Scores are limited to this absolute value [natural logarithm], where probabilities are 0 or 1 to double precision."""


def best_pairs(score: Floats) -> tuple[Integers, Integers]:
    """Find the pairs with the largest total score; elements that would lower it have no partner.

    Args:
        score: (P, Q) log-likelihood ratio that two elements are partners, against that both have none.

    Returns:
        Rows and columns of the pairs, each (n,).
    """
    rows, columns = linear_sum_assignment(-np.maximum(score, 0))
    good = score[rows, columns] > 0
    return rows[good], columns[good]


def pair_probabilities(score: Floats) -> Floats:
    """Compute the probability (P, Q) of each pair, over all assignments, by belief propagation ([Chertkov2010]).

    Args:
        score: (P, Q) as for `best_pairs`.
    """
    score = np.clip(score, -_LARGEST_SCORE, _LARGEST_SCORE)
    from_rows, from_columns = np.zeros_like(score), np.zeros_like(score)
    for _ in range(_ROUNDS):
        before = from_rows
        from_rows = -_others(score + from_columns, 1)
        from_columns = -_others(score + from_rows, 0)
        # Half of the step; otherwise, the messages of two equal columns oscillate.
        from_rows = (from_rows + before) / 2
        if np.max(np.abs(from_rows - before), initial=0) < _TOLERANCE:
            break
    return np.asarray(expit(score + from_rows + from_columns))


def _others(messages: Floats, axis: int) -> Floats:
    """Compute log(1 + sum of the exponentials of all others along an axis)."""
    top = np.maximum(messages.max(axis=axis, keepdims=True), 0)
    share = np.exp(messages - top)
    rest = np.exp(-top) + share.sum(axis=axis, keepdims=True) - share
    return np.asarray(top + np.log(np.maximum(rest, 1e-300)))
