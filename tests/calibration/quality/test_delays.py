"""Cameras that recorded everything too late: the delay from the turns of the board, before any pose is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.made_boards import BOARD, MadeSession, made_session

from marey.arrays import Floats
from marey.calibration.adjustment.solve import agreeing_pictures
from marey.calibration.adjustment.start import start_lenses
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.delays import CameraDelay, find_delays, without_delays


@cache
def session() -> MadeSession:
    return made_session(cameras=4, pictures=110, seed=3)


@cache
def lenses() -> Floats:
    return start_lenses(session().corners, BOARD)


def delayed(corners: CornerSet, camera: int, pictures: int) -> CornerSet:
    """The corners if a camera had been late, recorded as long as the others."""
    picture = corners.picture + np.where(corners.camera == camera, pictures, 0)
    moved = replace(corners, picture=picture).subset((picture >= 0) & (picture < len(corners.pictures)))
    return moved.ordered(np.lexsort((moved.corner, moved.camera, moved.picture)))


@pytest.mark.slow
@pytest.mark.parametrize(("camera", "pictures"), [(2, 7), (0, -4), (3, 1)])
def test_a_constant_delay_is_found(camera: int, pictures: int):
    found = find_delays(delayed(session().corners, camera, pictures), BOARD, lenses())
    assert [(each.camera, each.pictures) for each in found] == [(camera, pictures)]


def test_synchronous_cameras_have_no_delay():
    assert find_delays(session().corners, BOARD, lenses()) == ()


@pytest.mark.slow
def test_boards_that_move_independently_have_no_delay():
    corners = session().corners
    order = np.random.default_rng(1).permutation(len(corners.pictures))
    picture = np.where(corners.camera % 2 == 1, order[corners.picture], corners.picture)
    mixed = replace(corners, picture=picture)
    assert find_delays(mixed.ordered(np.lexsort((mixed.corner, mixed.camera, picture))), BOARD, lenses()) == ()


@pytest.mark.slow
def test_without_its_delay_a_session_is_the_synchronous_one_but_for_its_ends():
    corners, late = session().corners, 5
    back = without_delays(delayed(corners, 1, late), [CameraDelay(camera=1, pictures=late, turns=0)])
    kept = corners.subset((corners.camera != 1) | (corners.picture < len(corners.pictures) - late))
    for name in ("camera", "picture", "corner", "pixels"):
        np.testing.assert_array_equal(getattr(back, name), getattr(kept, name))
    before = agreeing_pictures(delayed(corners, 1, late), BOARD, lenses())
    assert agreeing_pictures(back, BOARD, lenses()) > 1.2 * before
