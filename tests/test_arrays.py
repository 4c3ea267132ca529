"""Helpers for arrays."""

import numpy as np
import pytest

from marey.arrays import true_runs


@pytest.mark.parametrize(
    ("mask", "runs"),
    [
        ([], []),
        ([0, 0], []),
        ([1, 1], [(0, 2)]),
        ([0, 1, 0, 1, 1], [(1, 2), (3, 5)]),
    ],
)
def test_runs_begin_at_a_true_element_and_end_before_a_false_one(mask, runs):
    assert true_runs(np.array(mask, bool)) == runs
