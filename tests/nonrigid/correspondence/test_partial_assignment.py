from itertools import permutations

import numpy as np
import pytest

from marey.nonrigid.correspondence.partial_assignment import best_pairs, pair_probabilities


def exact(score):
    """Add up all assignments of a small table."""
    p, q = score.shape
    total, chance = 0.0, np.zeros(score.shape)
    # Each row takes one column or, beyond the table, none.
    for choice in set(permutations([*range(q), *[-1] * p], p)):
        pairs = [(row, column) for row, column in enumerate(choice) if column >= 0]
        weight = np.exp(sum(score[pair] for pair in pairs))
        total += weight
        for pair in pairs:
            chance[pair] += weight
    return chance / total


def test_elements_that_would_lower_the_score_have_no_partner():
    rows, columns = best_pairs(np.array([[3.0, 2.0, -1.0], [2.5, -1.0, -2.0], [-3.0, -2.0, -1.0]]))
    assert list(zip(rows, columns, strict=True)) == [(0, 1), (1, 0)]


@pytest.mark.parametrize("spread", [0.5, 2.0, 5.0])
def test_probabilities_are_near_those_of_all_assignments(spread):
    random = np.random.default_rng(1)
    for _ in range(5):
        score = spread * random.normal(size=(3, 4))
        # Belief propagation is exact on trees; on full tables it is off by a few hundredths.
        np.testing.assert_allclose(pair_probabilities(score), exact(score), atol=0.12)


def test_a_single_pair_has_the_odds_of_its_score():
    np.testing.assert_allclose(pair_probabilities(np.array([[1.5]])), 1 / (1 + np.exp(-1.5)), atol=1e-4)


def test_equal_rivals_share_their_probability():
    chance = pair_probabilities(np.full((2, 2), 20.0))
    np.testing.assert_allclose(chance, 0.5, atol=0.01)
