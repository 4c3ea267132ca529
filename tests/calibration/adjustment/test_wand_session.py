"""Sessions with a wand, without anything known of the lenses: the truth within its covariance."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_wands import TAGS, MadeWand, made_wand

from marey.calibration.adjustment.landmarks import LandmarkWorld, in_landmark_world, solve_landmarks
from marey.calibration.adjustment.solve import SolvedSession, solve_session
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.boards.wand import CalibrationWand, Landmark
from marey.calibration.quality.world import centre_slope, centres

SPREAD = 0.01 * np.eye(2)


def in_world(made: MadeWand, solved: SolvedSession, landmarks: tuple[Landmark, ...]) -> LandmarkWorld:
    found = in_landmark_world(solved, landmarks, {key: (pixel, SPREAD) for key, pixel in made.seen.items()})
    assert found is not None
    return found


@pytest.fixture(scope="module")
def made() -> MadeWand:
    return made_wand(cameras=4, pictures=90, seed=3)


@pytest.fixture(scope="module")
def solved(made: MadeWand) -> SolvedSession:
    return solve_session(made.corners, made.wand)


@pytest.fixture(scope="module")
def world(made: MadeWand, solved: SolvedSession) -> LandmarkWorld:
    return in_world(made, solved, made.landmarks)


def test_lenses_and_poses_are_the_true_ones_within_their_covariance(made: MadeWand, world: LandmarkWorld):
    solved = world.solved
    sd = np.sqrt(np.diag(solved.covariance))[: CAMERA * 4].reshape(4, CAMERA)
    true = np.array(
        [[c.matrix[0, 0], c.matrix[1, 1], c.matrix[0, 2], c.matrix[1, 2], *c.distortion] for c in made.rig]
    )
    off = (solved.state.lens[:, :8] - true) / sd[:, :8]
    assert np.mean(off**2) < 2.5
    assert np.abs(off).max() < 4.5
    for camera, shift in enumerate(centres(solved.state) - made.rig.centres):
        own = slice(CAMERA * camera + LENS, CAMERA * (camera + 1))
        slope = centre_slope(solved.state, camera)
        spread = slope @ solved.covariance[own, own] @ slope.T
        # Chi-square with three degrees of freedom exceeds 21 once in ten thousand times.
        assert shift @ np.linalg.solve(spread, shift) < 21.1


def test_nothing_is_left_out_and_the_noise_is_estimated(world: LandmarkWorld):
    assert world.solved.adjusted.unit == pytest.approx(1.0, abs=0.08)
    assert world.solved.left_out == ()
    assert world.wrong == ()
    assert not world.mirrored


@pytest.mark.slow
def test_two_balls_that_look_alike_are_told_apart():
    made = made_wand(cameras=4, pictures=90, seed=3, wand=CalibrationWand(distances=(0.5,)))
    rng = np.random.default_rng(0)
    reverse = (rng.random(len(made.corners.view_starts)) < 0.5)[made.corners.view]
    corner = np.where(reverse, 1 - made.corners.corner, made.corners.corner)
    mixed = replace(made.corners, corner=corner)
    mixed = mixed.ordered(np.lexsort((corner, mixed.camera, mixed.picture)))
    solved = solve_session(mixed, made.wand)
    assert np.linalg.norm(solved.adjusted.residual, axis=1).max() < 1.0
    assert len(solved.corners) > 0.9 * len(mixed)
    true = np.array([camera.matrix[0, 0] for camera in made.rig])
    np.testing.assert_allclose(solved.state.lens[:, 0], true, rtol=3e-3)


def test_a_landmark_with_wrong_coordinates_is_named(made: MadeWand, solved: SolvedSession):
    wrong = (replace(TAGS[0], place=(-1.1, -1.0, 0.0)), *TAGS[1:])
    found = in_world(made, solved, wrong)
    assert [name for name, _ in found.wrong] == ["tag 0"]
    assert found.wrong[0][1] == pytest.approx(0.1, abs=0.01)
    assert found.used == ("tag 1", "tag 2", "tag 3")


@pytest.mark.slow
def test_left_handed_coordinates_are_recognised():
    marks = tuple(
        Landmark(name=f"p{k}", place=place, sd=1e-3)
        for k, place in enumerate([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.4), (1.0, 1.0, 0.0), (-0.8, 0.6, 1.0)])
    )
    made = made_wand(cameras=3, pictures=50, seed=3, landmarks=marks)
    solved = solve_session(made.corners, made.wand, model=False)
    flipped = tuple(replace(each, place=(each.place[0], -each.place[1], each.place[2])) for each in marks)
    assert in_world(made, solved, flipped).mirrored
    assert not in_world(made, solved, marks).mirrored


def test_landmarks_on_one_line_do_not_set_a_world(made: MadeWand, solved: SolvedSession):
    line = tuple(replace(each, place=(float(k), 0.0, 0.0)) for k, each in enumerate(TAGS))
    pixels = {key: (pixel, SPREAD) for key, pixel in made.seen.items()}
    assert in_landmark_world(solved, line, pixels) is None


def test_cameras_are_calibrated_from_points_alone():
    rng = np.random.default_rng(0)
    places = rng.uniform([-1.5, -1.5, 0], [1.5, 1.5, 2], (40, 3))
    marks = tuple(Landmark(name=f"p{k}", place=tuple(place.tolist()), sd=1e-4) for k, place in enumerate(places))
    made = made_wand(cameras=4, pictures=3, seed=5, landmarks=marks)
    pixels = {key: (pixel, SPREAD) for key, pixel in made.seen.items()}
    solved = solve_landmarks(made.rig.names, tuple(each.size for each in made.rig), marks, pixels)
    for camera, shift in enumerate(centres(solved.state) - made.rig.centres):
        own = slice(CAMERA * camera + LENS, CAMERA * (camera + 1))
        slope = centre_slope(solved.state, camera)
        spread = slope @ solved.covariance[own, own] @ slope.T
        assert shift @ np.linalg.solve(spread, shift) < 21.1
    assert np.linalg.norm(centres(solved.state) - made.rig.centres, axis=1).max() < 0.03
