"""Lags of cameras from the points of a wand, before anything is known of the cameras."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_wands import WAND, made_wand

from marey.calibration.boards.wand import CalibrationWand
from marey.calibration.timing.wand_lags import find_wand_lags, from_common_clock

TWO_BALLS = CalibrationWand(distances=(0.5,))


@pytest.mark.slow
@pytest.mark.parametrize("wand", [WAND, TWO_BALLS], ids=["three balls", "two balls that look alike"])
@pytest.mark.parametrize("late", [(0.0, 0.3, 0.0), (0.0, 0.0, 1.5), (-12.0, 0.0, 0.0)])
def test_lags_are_found_to_a_part_of_a_picture(wand: CalibrationWand, late: tuple[float, ...]):
    made = made_wand(cameras=3, pictures=250, seed=5, wand=wand, late=late, pace=0.4)
    corners = made.corners
    if wand.alike:
        reverse = (np.random.default_rng(0).random(len(corners.view_starts)) < 0.5)[corners.view]
        mixed = replace(corners, corner=np.where(reverse, 1 - corners.corner, corners.corner))
        corners = mixed.ordered(np.lexsort((mixed.corner, mixed.camera, mixed.picture)))
    found = find_wand_lags(corners, wand)
    # The middle of two balls in the image is not that of the wand: its lag is less certain.
    np.testing.assert_allclose(found.late, late, atol=0.1 if wand.alike else 0.05)
    assert len(np.unique(found.group)) == 1


def test_cameras_in_step_have_no_lag():
    made = made_wand(cameras=4, pictures=150, seed=1, pace=0.25)
    np.testing.assert_array_equal(find_wand_lags(made.corners, WAND).late, 0.0)


def test_pictures_in_random_order_have_no_lag():
    corners = made_wand(cameras=2, pictures=150, seed=1, pace=0.25).corners
    order = np.random.default_rng(1).permutation(150)
    mixed = replace(corners, picture=np.where(corners.camera == 1, order[corners.picture], corners.picture))
    found = find_wand_lags(mixed.ordered(np.lexsort((mixed.corner, mixed.camera, mixed.picture))), WAND)
    np.testing.assert_array_equal(found.late, 0.0)
    assert len(np.unique(found.group)) == 2


def test_the_clock_that_most_cameras_share_counts():
    late = from_common_clock(np.array([0.0, 3.02, 2.99, 3.0, -1.0]), np.full(5, 0.05))
    np.testing.assert_allclose(late, [-3.0, 0.02, -0.01, 0.0, -4.0], atol=0.021)
    np.testing.assert_array_equal(from_common_clock(np.array([1.0, 5.0]), np.full(2, 0.1)), [0.0, 4.0])
