"""Cameras that drift, or that lost pictures, are found from the points of a wand alone, and no others."""

import numpy as np
import pytest
from tests.made_wands import WAND, MadeWand, made_wand

from marey.calibration.timing.wand_faults import WandFault, find_wand_faults

PICTURES = 170
NUMBER = np.arange(PICTURES, dtype=float)


def made_with(late: np.ndarray, camera: int = 1, cameras: int = 3) -> MadeWand:
    """A session in which one camera is late by another number of pictures in each of its pictures."""
    own = [np.zeros(PICTURES)] * cameras
    own[camera] = late
    return made_wand(cameras=cameras, pictures=PICTURES, seed=4, late=own, pace=0.28)


def found_in(made: MadeWand) -> WandFault:
    (fault,) = find_wand_faults(made.corners, made.wand)
    return fault


@pytest.mark.slow
@pytest.mark.parametrize(("slow", "camera"), [(0.01, 1), (-0.002, 0)])
def test_a_drifting_clock_is_found_to_a_part_of_a_picture(slow: float, camera: int):
    fault = found_in(made_with(slow * NUMBER, camera))
    assert (fault.camera, fault.picture, fault.jump) == (camera, None, 0)
    # A picture n shows the instant n - slow n.
    np.testing.assert_allclose(fault.late, slow * NUMBER / (1 - slow), atol=0.1)
    assert fault.drift == pytest.approx(slow / (1 - slow), abs=0.1 / PICTURES)


@pytest.mark.slow
@pytest.mark.parametrize(("jump", "start"), [(-3, 0.4), (-1, 0.6), (2, 0.5)])
def test_lost_and_inserted_pictures_are_found(jump: int, start: float):
    first = int(start * PICTURES)
    made = made_with(np.where(first <= NUMBER, float(jump), 0.0))
    fault = found_in(made)
    assert (fault.camera, fault.jump, fault.drift) == (1, jump, 0.0)
    assert fault.picture is not None
    # The wand is not seen by two cameras all the time, and inserted pictures are near to those before them.
    assert abs(fault.picture - first) <= 8
    assert find_wand_faults(fault.retimed(made.corners), made.wand) == ()


def test_pictures_after_a_loss_are_moved_to_the_instants_that_they_show():
    made = made_with(np.where(NUMBER >= 100, -3.0, 0.0))
    late = np.where(NUMBER < 100, 0.0, np.where(NUMBER >= 103, -3.0, np.nan))
    fault = WandFault(camera=1, partner=0, late=late, picture=100, before=1.0, after=0.1)
    moved = fault.retimed(made.corners)
    own, before = moved.subset(moved.camera == 1), made.corners.subset(made.corners.camera == 1)
    assert not ((own.picture >= 100) & (own.picture < 103)).any()
    kept = before.subset((before.picture < 100) | (before.picture < PICTURES - 3))
    np.testing.assert_array_equal(own.pixels, kept.pixels)
    np.testing.assert_array_equal(own.picture, kept.picture + 3 * (kept.picture >= 100))
    other = moved.subset(moved.camera == 0)
    np.testing.assert_array_equal(other.pixels, made.corners.subset(made.corners.camera == 0).pixels)


@pytest.mark.slow
def test_two_clocks_are_found_beside_each_other():
    drifts = {1: 0.01, 2: -0.006}
    late = [drifts.get(camera, 0.0) * NUMBER for camera in range(4)]
    made = made_wand(cameras=4, pictures=PICTURES, seed=4, late=late, pace=0.28)
    found = {each.camera: each for each in find_wand_faults(made.corners, made.wand)}
    assert set(found) == set(drifts)
    for camera, drift in drifts.items():
        assert found[camera].partner not in drifts
        np.testing.assert_allclose(found[camera].late, drift * NUMBER / (1 - drift), atol=0.15)


@pytest.mark.parametrize("late", [0.0, 0.4, -12.0])
def test_cameras_that_are_in_step_or_late_by_a_constant_have_no_fault(late: float):
    made = made_with(np.full(PICTURES, late))
    assert find_wand_faults(made.corners, WAND) == ()


@pytest.mark.slow
def test_pictures_in_random_order_have_no_clock():
    corners = made_wand(cameras=2, pictures=150, seed=1, pace=0.25).corners
    order = np.random.default_rng(1).permutation(150)
    picture = np.where(corners.camera == 1, order[corners.picture], corners.picture)
    mixed = type(corners)(**{**vars(corners), "picture": picture})
    mixed = mixed.ordered(np.lexsort((mixed.corner, mixed.camera, mixed.picture)))
    assert find_wand_faults(mixed, WAND) == ()
