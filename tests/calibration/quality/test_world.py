"""The world of the board on the floor, and how certain it is."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_boards import made_session

from marey.calibration.adjustment.covariance import common_covariance
from marey.calibration.adjustment.solve import solve_session
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.boards.still import join_still
from marey.calibration.quality.world import find_floor, in_floor_world


@pytest.mark.slow
def test_the_covariance_contains_shifts_that_the_corners_of_a_view_of_the_floor_share():
    made = made_session(cameras=3, pictures=60, seed=3, noise=0.02)
    still = join_still(made.corners)
    solved = solve_session(still.corners, made.board, model=False)
    floor = find_floor(solved, still)
    assert floor is not None
    found = in_floor_world(solved, floor)
    added = found.covariance - common_covariance(found.adjusted)
    corners = solved.corners
    expected = np.zeros_like(added)
    for camera in np.unique(corners.camera[corners.picture == floor]):
        for axis in np.eye(2):
            pixels = np.array(corners.pixels)
            pixels[(corners.picture == floor) & (corners.camera == camera)] += 0.03 * axis
            problem = replace(solved.adjusted.problem, corners=replace(corners, pixels=pixels))
            moved = in_floor_world(replace(solved, adjusted=replace(solved.adjusted, problem=problem)), floor)
            step = np.zeros(len(added))
            for k in range(3):
                own = slice(CAMERA * k + LENS + 3, CAMERA * (k + 1))
                step[own] = moved.state.camera_translation[k] - found.state.camera_translation[k]
            expected += np.outer(step, step)
    for k in range(3):
        own = slice(CAMERA * k + LENS + 3, CAMERA * (k + 1))
        # The noise is estimated anew with each shift.
        np.testing.assert_allclose(added[own, own], expected[own, own], rtol=0.15, atol=0.1 * expected[own, own].max())
    sd = np.sqrt(np.diag(added))[CAMERA * 0 + LENS + 3 : CAMERA]
    assert (sd > 0).all()
