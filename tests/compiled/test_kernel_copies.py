"""Copies inside kernels are those of slices, in any layout."""

import numpy as np
import pytest

from marey.compiled.kernel_copies import copy_matrix, copy_row


@pytest.mark.parametrize("turn", [lambda a: a, lambda a: a[::-1]])
def test_a_row_is_copied(rng, turn):
    source, target = rng.normal(size=7), np.zeros(7)
    copy_row(turn(target), source)
    np.testing.assert_array_equal(turn(target), source)


@pytest.mark.parametrize("turn", [lambda a: a, lambda a: a.T, lambda a: a[:, ::-1]])
def test_a_matrix_is_copied(rng, turn):
    target = np.zeros((3, 4))
    source = rng.normal(size=turn(target).shape)
    copy_matrix(turn(target), source)
    np.testing.assert_array_equal(turn(target), source)
    copy_matrix(turn(target), turn(rng.normal(size=(3, 4))).copy())
    assert np.all(target != 0)
