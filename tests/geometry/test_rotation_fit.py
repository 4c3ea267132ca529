import numpy as np
import pytest

from marey.geometry import rotations
from marey.geometry.rotation_fit import fit_rotation


def fitted(cross):
    out = np.empty((3, 3))
    fit_rotation(np.ascontiguousarray(cross), np.empty((2, 4, 4)), out)
    return out


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.4, 2.0, np.pi])
@pytest.mark.parametrize("flat", [False, True])
def test_a_rotation_is_recovered(rng, angle, flat):
    axis = rng.normal(size=3)
    turn = rotations.exp(angle * axis / np.linalg.norm(axis))
    before = rng.normal(size=(8, 3)) * [1.0, 1.0, 0.0 if flat else 1.0]
    np.testing.assert_allclose(fitted((before @ turn.T).T @ before), turn, atol=1e-13)


def test_the_rotation_is_that_of_the_singular_value_decomposition(rng):
    for _ in range(200):
        cross = rng.normal(size=(3, 3))
        left, _, right = np.linalg.svd(cross)
        expected = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        np.testing.assert_allclose(fitted(cross), expected, atol=1e-9)


def test_the_result_is_a_rotation_also_where_none_is_determined():
    for cross in (np.zeros((3, 3)), np.diag([1.0, 0, 0]), -np.eye(3)):
        found = fitted(cross)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(found) == pytest.approx(1)
