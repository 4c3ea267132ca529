"""Runs of still pictures: found where the board rests, and joined without a smaller covariance."""

import numpy as np
from tests.made_boards import made_session

from marey.calibration.boards.still import join_still


def test_the_board_at_rest_is_one_run_and_its_corners_are_averaged():
    corners = made_session(cameras=3, pictures=40, seed=1, floor=8).corners
    still = join_still(corners)
    assert still.runs() == [(32, 39)]
    np.testing.assert_array_equal(still.first[:32], np.arange(32))
    joined = still.corners.picture == 32
    key = still.corners.camera[joined][0], still.corners.corner[joined][0]
    own = (corners.picture >= 32) & (corners.camera == key[0]) & (corners.corner == key[1])
    np.testing.assert_allclose(still.corners.pixels[joined][0], corners.pixels[own].mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(still.corners.covariance[joined][0], corners.covariance[own][0], atol=1e-12)


def test_a_board_that_moves_is_left_as_it_is():
    corners = made_session(cameras=2, pictures=20, seed=2, floor=0).corners
    still = join_still(corners)
    assert still.runs() == []
    assert still.corners is corners
