"""Paths of points in images: exact at the pictures, near the truth between them, with motions and errors."""

import numpy as np
import pytest

from marey.calibration.boards.corners import CornerSet
from marey.calibration.timing.image_paths import ImagePaths

RATE = 0.3
"""Angular velocity of the points [rad per picture]."""


def circling(time: np.ndarray) -> np.ndarray:
    return np.stack([640 + 300 * np.cos(RATE * time), 360 + 200 * np.sin(RATE * time)], axis=-1)


def corners(pictures: dict[int, list[int]], count: int = 40) -> CornerSet:
    """One point in some pictures of each camera."""
    camera = np.concatenate([np.full(len(own), k) for k, own in pictures.items()])
    picture = np.concatenate([np.array(own, int) for own in pictures.values()])
    found = CornerSet(
        cameras=tuple(f"cam{k}" for k in pictures), sizes=((1280, 720),) * len(pictures),
        pictures=tuple(str(k) for k in range(count)), camera=camera, picture=picture,
        corner=np.zeros(len(picture), int), pixels=circling(picture),
        covariance=np.broadcast_to(0.01 * np.eye(2), (len(picture), 2, 2)),
    )  # fmt: skip
    return found.ordered(np.lexsort((found.corner, found.camera, found.picture)))


def test_points_between_pictures_are_near_the_truth_and_their_motion_is_its_derivative():
    every = list(range(40))
    found = ImagePaths.through(corners({0: every, 1: every})).at(np.array([0.0, 0.4]), np.array([False, True]))
    own = found.camera == 1
    time = found.picture[own] + 0.4
    assert found.picture[own].tolist() == list(range(39))
    inner = slice(2, -2)
    # The error of a cubic spline is h^4 u''''/384, up to twice that near the ends.
    bound = 2 * 300 * RATE**4 / 384
    np.testing.assert_allclose(found.pixels[own][inner], circling(time)[inner], atol=bound)
    assert found.motion is not None
    ahead = (circling(time + 1e-4) - circling(time - 1e-4)) / 2e-4
    np.testing.assert_allclose(found.motion[own][inner], ahead[inner], atol=300 * RATE**4 / 24)
    np.testing.assert_array_equal(found.motion[~own], 0.0)


def test_the_points_of_a_clock_that_drifts_are_interpolated_at_its_own_times():
    every = list(range(40))
    found = ImagePaths.through(corners({0: every})).at(np.array([0.4]), np.array([True]), np.array([0.05]))
    time = found.picture + 0.4 + 0.05 * (found.picture - 19.5)
    assert found.picture.tolist() == list(range(1, 38))
    assert time[0] >= 0 > time[0] - 1.05
    assert time[-1] <= 39 < time[-1] + 1.05
    inner = slice(3, -3)
    np.testing.assert_allclose(found.pixels[inner], circling(time)[inner], atol=2 * 300 * RATE**4 / 384)


def test_the_covariance_contains_the_error_of_the_interpolation():
    every = list(range(40))
    found = ImagePaths.through(corners({0: every})).at(np.array([0.5]), np.array([True]))
    error = np.linalg.norm(found.pixels - circling(found.picture + 0.5), axis=1)
    added = np.sqrt(np.trace(found.covariance - 0.01 * np.eye(2), axis1=1, axis2=2))
    assert np.all(added > 0.3 * error)
    assert np.median(added / error) == pytest.approx(1.4, rel=0.5)


def test_whole_delays_move_points_to_other_instants_and_change_nothing_else():
    given = corners({0: list(range(5, 30)), 1: [3, 4, 20, 39]})
    found = ImagePaths.through(given).at(np.array([7.0, -1.0]), np.array([False, False]))
    first, second = found.subset(found.camera == 0), found.subset(found.camera == 1)
    assert first.picture.tolist() == list(range(23))
    np.testing.assert_array_equal(first.pixels, circling(first.picture + 7))
    # The last picture of the second camera shows an instant after the end.
    assert second.picture.tolist() == [4, 5, 21]
    np.testing.assert_array_equal(found.covariance, 0.01 * np.broadcast_to(np.eye(2), (len(found), 2, 2)))


def test_points_without_enough_neighbours_are_not_interpolated():
    given = corners({0: [0, 1, 2, 5, 6, 7, 8, 20]})
    found = ImagePaths.through(given).at(np.array([0.5]), np.array([True]))
    assert found.picture.tolist() == [5, 6, 7]
    still = ImagePaths.through(given).at(np.array([0.0]), np.array([True]))
    assert still.motion is not None
    assert np.flatnonzero(np.any(still.motion != 0, axis=1)).tolist() == [3, 4, 5, 6]
