"""The whole sequence in one system: its algebra against a dense solve, and a motion found again with honest bounds."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.pose import PosedBody
from marey.fit import sequence
from marey.fit.sequence import SequenceSettings, acceleration_spread, refine_sequence

FRAMES, DEGREES, NUMBERS = 6, 4, 3


def random_system(rng, numbers=NUMBERS):
    """A random positive system of the shape that poses, smoothness and a border give, and the same one dense."""
    system = sequence._System.empty(FRAMES, DEGREES, numbers)
    size = FRAMES * DEGREES + numbers
    dense, gradient = np.zeros((size, size)), np.zeros(size)
    shape = list(range(FRAMES * DEGREES, size))
    for f in range(FRAMES):
        own = [*range(f * DEGREES, (f + 1) * DEGREES), *shape]
        rows = rng.normal(size=(20, len(own)))
        hessian, slope = rows.T @ rows, rng.normal(size=len(own))
        system.add_frame(f, hessian, slope, DEGREES)
        dense[np.ix_(own, own)] += hessian
        gradient[own] += slope
    return system, dense, gradient


def add_smoothness(rng, system, dense, gradient):
    """Smoothness is linear where a pose's turn stays small: here the poses of a body without turns."""
    spread = rng.uniform(0.5, 2.0, DEGREES)
    values = rng.normal(size=(FRAMES, DEGREES))

    class Flat:
        """A pose without turns."""

        def __init__(self, value):
            self.value = value

        def change_to(self, other):
            return other.value - self.value

    for f in range(1, FRAMES - 1):
        system.add_smoothness(f, [Flat(v) for v in values], spread)
        jacobian = np.zeros((DEGREES, len(gradient)))
        for offset, share in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            columns = (f + offset) * DEGREES + np.arange(DEGREES)
            jacobian[np.arange(DEGREES), columns] = share
        residual = values[f + 1] - 2 * values[f] + values[f - 1]
        dense += jacobian.T @ (jacobian / spread[:, None] ** 2)
        gradient += jacobian.T @ (residual / spread**2)


FAR = (np.full(NUMBERS, -1e6), np.full(NUMBERS, 1e6))


@pytest.mark.parametrize("numbers", [0, NUMBERS])
def test_the_banded_solution_is_the_dense_one(rng, numbers):
    system, dense, gradient = random_system(rng, numbers)
    add_smoothness(rng, system, dense, gradient)
    step, shape = system.solve(np.full(DEGREES, np.inf), np.inf, FAR)
    expected = -np.linalg.solve(dense, gradient)
    np.testing.assert_allclose(np.concatenate([step, shape]), expected, atol=1e-8)


def test_where_the_shape_is_held_back_the_poses_take_the_best_step_beside_it(rng):
    system, dense, gradient = random_system(rng, NUMBERS)
    add_smoothness(rng, system, dense, gradient)
    _, free = system.solve(np.full(DEGREES, np.inf), np.inf, FAR)
    held = 0.3 * np.abs(free)
    step, shape = system.solve(np.full(DEGREES, np.inf), np.inf, (-held, held))
    assert np.all(np.abs(shape) <= held * (1 + 1e-6) + 1e-8)
    slope = gradient + dense @ np.concatenate([step, shape])
    np.testing.assert_allclose(slope[: len(step)], 0.0, atol=1e-7 * np.abs(gradient).max())
    # At a bound the cost would fall only by leaving it.
    assert np.all(slope[len(step) :] * np.sign(shape) <= 1e-7 * np.abs(gradient).max())


@pytest.mark.parametrize("numbers", [0, NUMBERS])
def test_the_covariances_are_blocks_of_the_dense_inverse(rng, numbers):
    system, dense, gradient = random_system(rng, numbers)
    add_smoothness(rng, system, dense, gradient)
    covariance = sequence._covariances(system, DEGREES)
    inverse = np.linalg.inv(dense)
    for f in range(FRAMES):
        own = [*range(f * DEGREES, (f + 1) * DEGREES), *range(FRAMES * DEGREES, len(dense))]
        np.testing.assert_allclose(covariance[f], inverse[np.ix_(own, own)], atol=1e-7 * np.abs(inverse).max())


def test_joints_accelerate_more_than_the_trunk_and_shorter_frames_allow_less():
    skeleton, settings = worlds.person().skeleton, SequenceSettings()
    spread = acceleration_spread(skeleton, settings)
    assert len(spread) == len(skeleton)
    assert spread[6 + worlds.column(skeleton, "left_elbow_flexion")] == settings.limb_acceleration
    assert spread[6 + worlds.column(skeleton, "thoracic_rotation")] == settings.trunk_acceleration
    np.testing.assert_array_equal(spread[:3], settings.root_acceleration)


@pytest.fixture(scope="module")
def motion():
    """A smooth motion of nine frames, its silhouettes with noise, and poses near the truth."""
    rng = np.random.default_rng(5)
    body, cameras = worlds.person("fine"), worlds.ring()
    truth = [PosedBody(body, pose) for pose in worlds.swing(body, 9)]
    levels = worlds.levels(truth, cameras, noise=0.7, rng=rng)
    start = [p.pose.step(rng.normal(size=len(body.skeleton)) * 0.02) for p in truth]
    return body, truth, levels, start


def normalised_squares(fit, truth):
    """Squared errors of the poses in units of their stated covariance, by degree of freedom (F,)."""
    degrees = len(fit.body.skeleton)
    squares = []
    for pose, true, covariance in zip(fit.poses, truth, fit.covariance, strict=True):
        change = true.pose.change_to(pose)
        squares.append(change @ np.linalg.solve(covariance[:degrees, :degrees], change) / degrees)
    return np.array(squares)


def test_a_motion_is_refined_and_its_covariance_is_honest(motion):
    body, truth, levels, start = motion
    fit = refine_sequence(range(9), start, body, levels, rate=30, rounds=4)
    before = np.mean([worlds.joint_errors(PosedBody(body, p), t) for p, t in zip(start, truth, strict=True)])
    after = np.mean([worlds.joint_errors(PosedBody(body, p), t) for p, t in zip(fit.poses, truth, strict=True)])
    assert after < 0.4 * before
    assert after < 0.009
    # One frame's square has a spread of sqrt(2 / D) = 0.19 if the model were exact; a factor of three either way
    # is what an outline's noise, alike between neighbours, is known to.
    assert 1 / 3 < normalised_squares(fit, truth).mean() < 3
    assert 0.1 < fit.residual_px < 1.5
    np.testing.assert_array_equal(fit.frames, np.arange(9))
    assert fit.covariance.shape == (9, len(body.skeleton), len(body.skeleton))


def test_neighbours_make_a_motion_smoother_and_its_frames_more_certain(motion):
    body, _, levels, start = motion
    together = refine_sequence(range(9), start, body, levels, rate=30, rounds=3)
    # Frames whose numbers do not follow each other know nothing of each other.
    apart = refine_sequence(range(0, 9, 2), start[::2], body, levels, rate=30, rounds=3)

    def roughness(poses):
        middle = zip(poses, poses[1:], poses[2:], strict=False)
        return np.mean([np.abs(a.change_to(b) - b.change_to(c)).mean() for a, b, c in middle])

    assert roughness(together.poses) < 0.5 * roughness(start)
    alone = np.trace(apart.covariance[2])
    assert np.trace(together.covariance[4]) < alone
    # What a frame alone says, with nothing from its neighbours, inverts to its covariance.
    np.testing.assert_allclose(apart.covariance[2], np.linalg.inv(apart.information[2]), rtol=1e-2, atol=1e-7)


def test_shape_and_motion_are_found_together():
    rng = np.random.default_rng(7)
    mean = worlds.person("fine", 4)
    person = mean.with_numbers(np.array([1.2, -0.8, 0.6, 0.5]))
    truth = [PosedBody(person, pose) for pose in worlds.swing(person, 9)]
    levels = worlds.levels(truth, worlds.ring())
    start = [p.pose.step(rng.normal(size=len(mean.skeleton)) * 0.01) for p in truth]
    fit = refine_sequence(range(9), start, mean, levels, rate=30, rounds=6, shape_frames=range(0, 9, 2))
    sd = np.sqrt(np.diag(fit.body.numbers_covariance))
    assert (np.abs(fit.body.numbers - person.numbers) < 4 * sd + 0.05).all()
    assert (sd < 0.3).all()
    errors = [worlds.joint_errors(PosedBody(fit.body, pose), true) for pose, true in zip(fit.poses, truth, strict=True)]
    assert np.mean(errors) < 0.008
    degrees = len(mean.skeleton)
    assert fit.covariance.shape == (9, degrees + 4, degrees + 4)
    np.testing.assert_allclose(fit.covariance[3][degrees:, degrees:], fit.body.numbers_covariance, rtol=1e-5)


def test_the_shape_stays_within_three_spreads_of_other_people():
    mean = worlds.person("coarse", 2)
    giant = mean.with_numbers(np.array([6.0, 0.0]))
    truth = [PosedBody(giant, worlds.pose(giant)) for _ in range(3)]
    fit = refine_sequence(
        range(3), [t.pose for t in truth], mean, worlds.levels(truth, worlds.ring()), rate=30, rounds=12,
        shape_frames=range(3),
    )  # fmt: skip
    assert fit.body.numbers[0] == pytest.approx(3.0)


def test_a_sequence_of_one_frame_is_refined_and_done_is_told(motion):
    body, truth, levels, start = motion
    told = []
    fit = refine_sequence([4], [start[4]], body, levels, rate=30, rounds=3, done=told.append)
    assert told == [4, 4, 4]
    assert worlds.joint_errors(PosedBody(body, fit.poses[0]), truth[4]).mean() < 0.015


def test_frames_without_anybody_are_bridged_by_their_neighbours(motion):
    body, truth, levels, start = motion
    nobody = levels.at(4)
    blind = replace(nobody, sightings=(), masks=(), cameras=())

    class Gap:
        """Levels of which one frame shows nobody."""

        def at(self, frame):
            return blind if frame == 4 else levels.at(frame)

    fit = refine_sequence(range(9), start, body, Gap(), rate=30, rounds=4)
    assert worlds.joint_errors(PosedBody(body, fit.poses[4]), truth[4]).mean() < 0.02
    seen, unseen = (np.trace(fit.covariance[f][:3, :3]) for f in (3, 4))
    assert unseen > 2 * seen


def test_no_rounds_are_no_fit(motion):
    body, _, levels, start = motion
    with pytest.raises(ValueError, match="one round"):
        refine_sequence(range(9), start, body, levels, rate=30, rounds=0)


def test_a_scan_keeps_its_shape():
    body = worlds.scan()
    truth = [PosedBody(body, pose) for pose in worlds.swing(body, 3)]
    levels = worlds.levels(truth, worlds.ring())
    fit = refine_sequence(range(3), [t.pose for t in truth], body, levels, rate=30, rounds=2, shape_frames=[1])
    np.testing.assert_array_equal(fit.body.vertices, body.vertices)
    assert worlds.joint_errors(PosedBody(fit.body, fit.poses[1]), truth[1]).mean() < 0.003


def test_intervals_of_joint_centres_hold_the_truth_also_where_the_shape_is_found_with_them():
    rng = np.random.default_rng(5)
    mean = worlds.person("fine", 4)
    person = mean.with_numbers(np.array([1.2, -0.8, 0.6, 0.5]))
    truth = [PosedBody(person, pose) for pose in worlds.swing(person, 9)]
    levels = worlds.levels(truth, worlds.ring(), noise=0.7, rng=rng)
    start = [p.pose.step(rng.normal(size=len(mean.skeleton)) * 0.02) for p in truth]
    fit = refine_sequence(range(9), start, mean, levels, rate=30, rounds=8, shape_frames=range(9))
    joints, ratios = mean.joint_segments, []
    for pose, true, covariance in zip(fit.poses, truth, fit.covariance, strict=True):
        posed = PosedBody(fit.body, pose)
        by_pose = posed.pose_jacobian(*posed.joint_parts(joints))
        jacobian = np.concatenate([by_pose, posed.origin_shape_jacobian()[joints]], 2)
        sd = np.sqrt(np.einsum("jad,de,jae->ja", jacobian, covariance, jacobian))
        ratios.append((posed.segment_origin - true.segment_origin)[joints] / sd)
    # Errors of one take hang together, in time and along limbs: the share that is held wanders about its 95 in 100.
    held = np.mean(np.abs(ratios) < 1.96)
    assert held > 0.85
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.5
