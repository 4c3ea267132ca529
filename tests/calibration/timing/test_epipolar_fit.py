"""The fundamental matrix that suits most points, compared with the plain formula."""

import numpy as np
import pytest
from tests.made_wands import made_wand

from marey.calibration.timing.epipolar_fit import epipolar_fit, null_vector, point_distances


def common_points(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) of a wand that two cameras see at the same instants, shifted and scaled to about one."""
    corners = made_wand(cameras=2, pictures=150, seed=seed, pace=0.25).corners
    found = np.full((2, 3, len(corners.pictures), 2), np.nan)
    found[corners.camera, corners.corner, corners.picture] = (corners.pixels - 320.0) / 640.0
    known = np.isfinite(found[..., 0]).all(axis=0)
    return found[0][known], found[1][known]


def sampson_distance(matrix: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    own, a, b = matrix.reshape(3, 3), np.append(first, 1.0), np.append(second, 1.0)
    line, back = own @ a, own.T @ b
    return abs(b @ own @ a) / np.sqrt(line[0] ** 2 + line[1] ** 2 + back[0] ** 2 + back[1] ** 2)


def test_the_distance_is_that_of_sampson():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 4, 5, 2))
    matrix = rng.normal(size=9)
    found = point_distances(matrix, first, second)
    for index in np.ndindex(4, 5):
        assert found[index] == pytest.approx(sampson_distance(matrix, first[index], second[index]))


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_the_matrix_is_the_one_that_was_planted(wrong: float):
    first, second = common_points(2)
    rng = np.random.default_rng(1)
    bad = rng.random(len(first)) < wrong
    second = np.where(bad[:, None], rng.uniform(-0.5, 0.5, second.shape), second)
    matrix, median = epipolar_fit(first, second)
    good = point_distances(matrix, first, second)[~bad]
    assert median == pytest.approx(np.median(point_distances(matrix, first, second)), rel=0.2)
    # 0.6 px: noise of 0.1 px, and the distortion of the lenses, which no fundamental matrix describes.
    assert np.median(good) < 1e-3
    assert np.median(point_distances(np.roll(matrix, 1), first, second)) > 0.02


def test_fewer_points_that_are_wrong_than_right_hardly_change_the_matrix():
    first, second = common_points(2)
    exact = epipolar_fit(first, second)[0]
    moved = np.where(np.arange(len(first))[:, None] % 5 == 0, second[::-1], second)
    found = epipolar_fit(first, moved)[0]
    apart = point_distances(found, first, second)
    assert np.percentile(apart, 90) < 2.0 * np.percentile(point_distances(exact, first, second), 90)


def test_the_null_vector_is_the_least_singular_vector():
    rng = np.random.default_rng(3)
    for _ in range(20):
        equations = rng.normal(size=(8, 9)) * np.exp(rng.normal(size=(8, 1)))
        found, exact = null_vector(equations), np.linalg.svd(equations)[2][-1]
        assert np.linalg.norm(found) == pytest.approx(1.0)
        np.testing.assert_allclose(found * np.sign(found @ exact), exact, atol=1e-9)


def test_dependent_equations_leave_a_vector_that_satisfies_them():
    equations = np.zeros((3, 4))
    equations[:, 1] = 1.0
    found = null_vector(equations)
    np.testing.assert_allclose(equations @ found, 0.0, atol=1e-12)
    assert np.linalg.norm(found) == pytest.approx(1.0)
