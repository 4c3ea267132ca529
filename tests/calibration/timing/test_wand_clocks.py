"""Cameras out of step that record a wand: their delays within their intervals, and cameras as good as in step."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_wands import TAGS, MadeWand, made_wand

from marey.calibration.adjustment.landmarks import in_landmark_world
from marey.calibration.adjustment.solve import SolvedSession, solve_session
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationWand
from marey.calibration.quality.world import centre_slope, centres
from marey.calibration.timing.wand_clocks import StatedDelay, WandClocks, solve_wand_videos, stated_delays

LATE = (0.0, 0.37, -4.6)
PICTURES, PACE = 170, 0.28


def made_late(late: tuple[float, ...] = LATE, wand: CalibrationWand | None = None, seed: int = 4) -> MadeWand:
    own = {} if wand is None else {"wand": wand}
    return made_wand(cameras=3, pictures=PICTURES, seed=seed, late=late, pace=PACE, **own)


def in_world(made: MadeWand, solved: SolvedSession) -> SolvedSession:
    found = in_landmark_world(solved, TAGS, {key: (pixel, 0.01 * np.eye(2)) for key, pixel in made.seen.items()})
    assert found is not None
    return found.solved


def delays_of(clocks: WandClocks, solved: SolvedSession) -> dict[int, StatedDelay]:
    return {each.camera: each for each in stated_delays(clocks, solved)}


def assert_cameras_are_right(made: MadeWand, solved: SolvedSession) -> None:
    for camera, shift in enumerate(centres(solved.state) - made.rig.centres):
        own = slice(CAMERA * camera + LENS, CAMERA * (camera + 1))
        slope = centre_slope(solved.state, camera)
        spread = slope @ solved.covariance[own, own] @ slope.T
        # Chi-square with three degrees of freedom exceeds 21 once in ten thousand times.
        assert shift @ np.linalg.solve(spread, shift) < 21.1
        sd = np.sqrt(solved.covariance[CAMERA * camera, CAMERA * camera])
        assert abs(solved.state.lens[camera, 0] - made.rig.cameras[camera].matrix[0, 0]) < 4 * sd


@pytest.fixture(scope="module")
def made() -> MadeWand:
    return made_late()


@pytest.fixture(scope="module")
def found(made: MadeWand) -> tuple[SolvedSession, WandClocks]:
    solved, clocks = solve_wand_videos(made.corners, made.wand)
    return in_world(made, solved), clocks


@pytest.mark.slow
def test_delays_are_the_true_ones_within_their_intervals(found: tuple[SolvedSession, WandClocks]):
    solved, clocks = found
    assert clocks.reference == 0
    delays = delays_of(clocks, solved)
    assert sorted(delays) == [1, 2]
    for camera, each in delays.items():
        assert each.used
        assert each.known
        assert 0 < each.sd < 0.01
        assert abs(each.pictures - LATE[camera]) < 4 * each.sd


@pytest.mark.slow
def test_cameras_out_of_step_are_as_right_as_their_covariance(
    made: MadeWand, found: tuple[SolvedSession, WandClocks]
):  # fmt: skip
    solved, _ = found
    assert_cameras_are_right(made, solved)
    assert solved.left_out == ()
    # Without the delays the cameras of this session are meters off, or not connected.
    assert np.linalg.norm(centres(solved.state) - made.rig.centres, axis=1).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("other", [0.0, 5.3])
def test_a_camera_that_drifts_is_allowed_for(other: float):
    slow = 0.01
    late = [np.zeros(PICTURES), slow * np.arange(PICTURES), np.full(PICTURES, other)]
    made = made_wand(cameras=3, pictures=PICTURES, seed=4, late=late, pace=PACE)
    solved, clocks = solve_wand_videos(made.corners, made.wand)
    assert (clocks.reference, len(clocks.faults)) == (0, 1)
    delays = delays_of(clocks, in_world(made, solved))
    assert abs(delays[2].pictures - other) < 4 * delays[2].sd < 0.02
    each = delays[1]
    assert each.used
    # A picture n shows the instant n - slow n; the delay is that in the middle of the session.
    true = slow / (1 - slow) * (PICTURES - 1)
    assert abs(each.drift - true) < 4 * each.drift_sd < 0.02
    assert abs(each.pictures - true / 2) < 4 * each.sd < 0.02
    assert_cameras_are_right(made, in_world(made, solved))


@pytest.mark.slow
def test_cameras_in_step_are_those_of_the_solution_without_delays():
    made = made_late((0.0, 0.0, 0.0), seed=6)
    solved, clocks = solve_wand_videos(made.corners, made.wand)
    plain = solve_session(made.corners, made.wand)
    assert not clocks.used.any()
    assert clocks.known.all()
    np.testing.assert_allclose(solved.state.lens[:, :4], plain.state.lens[:, :4], rtol=1e-5)
    np.testing.assert_allclose(solved.covariance, plain.covariance, rtol=0.02, atol=1e-12)
    for each in delays_of(clocks, solved).values():
        assert abs(each.pictures) < 4 * each.sd


@pytest.mark.slow
def test_a_late_first_camera_is_stated_against_the_clock_of_the_others():
    made = made_late((0.42, 0.0, 0.0))
    solved, clocks = solve_wand_videos(made.corners, made.wand)
    delays = delays_of(clocks, solved)
    assert clocks.reference != 0
    assert [camera for camera, each in delays.items() if each.used] == [0]
    assert abs(delays[0].pictures - 0.42) < 4 * delays[0].sd


@pytest.mark.slow
def test_two_balls_that_look_alike_by_cameras_out_of_step():
    made = made_late(wand=CalibrationWand(distances=(0.5,)))
    reverse = (np.random.default_rng(0).random(len(made.corners.view_starts)) < 0.5)[made.corners.view]
    mixed = replace(made.corners, corner=np.where(reverse, 1 - made.corners.corner, made.corners.corner))
    mixed = mixed.ordered(np.lexsort((mixed.corner, mixed.camera, mixed.picture)))
    solved, clocks = solve_wand_videos(mixed, made.wand)
    for camera, each in delays_of(clocks, solved).items():
        assert abs(each.pictures - LATE[camera]) < 4 * each.sd
    assert_cameras_are_right(made, in_world(made, solved))


@pytest.mark.slow
def test_a_camera_that_never_shows_consecutive_pictures_has_no_known_delay():
    made = made_late((0.0, 0.0, 0.0), seed=6)
    solved, clocks = solve_wand_videos(every_third(made.corners, 2), made.wand)
    each = delays_of(clocks, solved)[2]
    assert not each.known
    assert not each.used
    assert_cameras_are_right(made, in_world(made, solved))


def every_third(corners: CornerSet, camera: int) -> CornerSet:
    return corners.subset((corners.camera != camera) | (corners.picture % 3 == 0))
