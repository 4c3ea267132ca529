"""Refinement of a sequence: recovered motion and stated uncertainty, in windows and after an interruption."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.metaball_person import reshaped
from marey.fit.recipes import sequence
from marey.fit.recipes.sequence import (
    DISTINCT_FRAMES,
    RefineCheckpoint,
    SequenceSettings,
    acceleration_spread,
    refine_sequence,
    refine_without_covariances,
)
from marey.fit.search.levels import FrameLevels
from marey.fit.solver.banded import windows
from marey.fit.solver.picture_times import PictureTimes


def test_limbs_accelerate_more_than_the_trunk():
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


def test_neighbours_smooth_the_motion_and_reduce_its_uncertainty(motion):
    body, _, levels, start = motion
    together = refine_sequence(range(9), start, body, levels, rate=30, rounds=3)
    # Frames whose numbers are not consecutive are independent.
    apart = refine_sequence(range(0, 9, 2), start[::2], body, levels, rate=30, rounds=3)

    def roughness(poses):
        middle = zip(poses, poses[1:], poses[2:], strict=False)
        return np.mean([np.abs(a.change_to(b) - b.change_to(c)).mean() for a, b, c in middle])

    assert roughness(together.poses) < 0.5 * roughness(start)
    alone = np.trace(apart.covariance[2])
    assert np.trace(together.covariance[4]) < alone
    # Without neighbours, the inverse of a frame's own information is its covariance.
    np.testing.assert_allclose(apart.covariance[2], np.linalg.inv(apart.information[2]), rtol=1e-2, atol=1e-7)


@pytest.mark.slow
def test_shape_and_motion_are_estimated_together():
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
    prior = np.linalg.inv(fit.body.space.prior_covariance)
    seen = np.linalg.inv(fit.covariance[3][degrees:, degrees:]) - prior
    stated = np.linalg.inv(prior + DISTINCT_FRAMES / 5 * seen)
    np.testing.assert_allclose(fit.body.numbers_covariance, stated, rtol=1e-5)


@pytest.mark.slow
def test_metaball_sizes_are_estimated_and_an_interruption_changes_nothing():
    """The skin is computed again for the sizes of every round, in uninterrupted and resumed runs alike."""
    rng = np.random.default_rng(3)
    mean = metaball_person("simple", "coarse")
    numbers = 0.7 * np.linalg.cholesky(mean.space.prior_covariance) @ rng.normal(size=len(mean.space))
    person = reshaped(mean, numbers)
    truth = [PosedBody(person, pose) for pose in worlds.swing(person, 6)]
    levels = worlds.levels(truth, worlds.ring())
    options = {"rate": 30, "rounds": 5, "shape_frames": range(0, 6, 2)}
    checkpoint = RefineCheckpoint()
    fit = refine_sequence(range(6), [t.pose for t in truth], mean, levels, checkpoint=checkpoint, **options)
    lying = np.abs(mean.metaballs.balls(fit.body.numbers).at_rest().distance(fit.body.vertices))
    assert np.quantile(lying, 0.95) < 1e-6
    scale = np.sqrt(np.diag(mean.space.prior_covariance))
    assert np.linalg.norm((fit.body.numbers - numbers) / scale) < 0.5 * np.linalg.norm(numbers / scale)
    before, after = (
        np.mean([worlds.joint_errors(PosedBody(body, true.pose), true) for true in truth]) for body in (mean, fit.body)
    )
    assert after < 0.4 * before
    again = RefineCheckpoint(rounds={k: v for k, v in checkpoint.rounds.items() if k < 2})
    resumed = refine_sequence(range(6), [t.pose for t in truth], mean, levels, checkpoint=again, **options)
    np.testing.assert_array_equal(resumed.body.vertices, fit.body.vertices)


def test_poses_and_shape_without_covariances_are_those_with_them():
    mean = worlds.person("coarse", 2)
    truth = [PosedBody(mean.with_numbers(np.array([0.8, -0.5])), pose) for pose in worlds.swing(mean, 6)]
    levels, start = worlds.levels(truth, worlds.ring()), [t.pose for t in truth]
    options = {"rate": 30, "rounds": 3, "shape_frames": range(0, 6, 2)}
    fit = refine_sequence(range(6), start, mean, levels, **options)
    finished: list[int] = []
    poses, body = refine_without_covariances(range(6), start, mean, levels, progress=finished.append, **options)
    np.testing.assert_allclose(body.numbers, fit.body.numbers, atol=1e-8)
    for own, other in zip(poses, fit.poses, strict=True):
        assert np.abs(own.change_to(other)).max() < 1e-8
    assert finished == 3 * list(range(6))


def test_an_interruption_without_covariances_changes_nothing(motion):
    body, _, levels, start = motion
    kept = RefineCheckpoint()
    options = {"rate": 30, "rounds": 3}
    poses, _ = refine_without_covariances(range(9), start, body, levels, checkpoint=kept, **options)
    assert set(kept.rounds) == {0, 1, 2}
    assert not kept.parts
    begun = RefineCheckpoint(rounds={0: kept.rounds[0]})
    again, _ = refine_without_covariances(range(9), start, body, levels, checkpoint=begun, **options)
    for own, other in zip(again, poses, strict=True):
        np.testing.assert_array_equal(own.angles, other.angles)


def test_the_shape_stays_within_three_standard_deviations_of_the_prior():
    mean = worlds.person("coarse", 2)
    giant = mean.with_numbers(np.array([6.0, 0.0]))
    truth = [PosedBody(giant, worlds.pose(giant)) for _ in range(3)]
    fit = refine_sequence(
        range(3), [t.pose for t in truth], mean, worlds.levels(truth, worlds.ring()), rate=30, rounds=12,
        shape_frames=range(3),
    )  # fmt: skip
    assert fit.body.numbers[0] == pytest.approx(3.0)


def test_a_sequence_of_one_frame_is_refined_and_progress_is_reported(motion):
    body, truth, levels, start = motion
    finished = []
    fit = refine_sequence([4], [start[4]], body, levels, rate=30, rounds=3, progress=finished.append)
    assert finished == [4, 4, 4]
    assert worlds.joint_errors(PosedBody(body, fit.poses[0]), truth[4]).mean() < 0.015


def test_frames_without_a_person_follow_their_neighbours(motion):
    body, truth, levels, start = motion
    last_level = levels.at(4)
    ignored_frames = replace(last_level, sightings=(), masks=(), cameras=())

    class Gap:
        """Levels in one frame of which no person is detected."""

        def at(self, frame):
            return ignored_frames if frame == 4 else levels.at(frame)

    fit = refine_sequence(range(9), start, body, Gap(), rate=30, rounds=4)
    assert worlds.joint_errors(PosedBody(body, fit.poses[4]), truth[4]).mean() < 0.02
    seen, unsupported_frames = (np.trace(fit.covariance[f][:3, :3]) for f in (3, 4))
    assert unsupported_frames > 2 * seen


def test_zero_rounds_are_rejected(motion):
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


@pytest.mark.slow
def test_intervals_of_joint_centres_contain_the_truth_also_with_a_free_shape():
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
    # Errors of one take are correlated in time and along limbs: the share within the intervals scatters about 95 %.
    held = np.mean(np.abs(ratios) < 1.96)
    assert held > 0.85
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.5


@pytest.fixture(scope="module")
def long_motion():
    """A motion of forty frames of a small body whose shape is to be found too."""
    rng = np.random.default_rng(11)
    mean = worlds.person("coarse", 2)
    person = mean.with_numbers(np.array([0.8, -0.6]))
    truth = [PosedBody(person, pose) for pose in worlds.swing(person, 40)]
    levels = worlds.levels(truth, worlds.ring(3, size=(100, 120), focal=150.0), noise=0.4, rng=rng)
    start = [p.pose.step(rng.normal(size=len(mean.skeleton)) * 0.01) for p in truth]
    return mean, levels, start


def refined(long_motion, **more):
    mean, levels, start = long_motion
    return refine_sequence(range(40), start, mean, levels, rate=30, rounds=3, shape_frames=range(0, 40, 4), **more)


@pytest.mark.slow
def test_windows_give_the_solution_of_a_single_system(long_motion, monkeypatch):
    whole = refined(long_motion)
    monkeypatch.setattr(sequence, "windows", lambda count, length, overlap: windows(count, 10, 8))
    parts = refined(long_motion)
    np.testing.assert_array_equal(parts.frames, whole.frames)
    sd = np.sqrt(np.diag(whole.body.numbers_covariance))
    assert (np.abs(parts.body.numbers - whole.body.numbers) < 0.05 * sd).all()
    np.testing.assert_allclose(parts.body.numbers_covariance, whole.body.numbers_covariance, rtol=0.05, atol=1e-5)
    degrees = len(whole.body.skeleton)
    for one, other, a, b in zip(whole.poses, parts.poses, whole.covariance, parts.covariance, strict=True):
        spread = np.sqrt(np.diag(a))[:degrees]
        assert (np.abs(one.change_to(other)) < 0.05 * spread).all()
        np.testing.assert_allclose(np.sqrt(np.diag(b))[:degrees], spread, rtol=0.05)


class Broken(dict):
    """A checkpoint of a run that is interrupted once it contains so much."""

    def __init__(self, most, content=()):
        super().__init__(content)
        self.most = most

    def __setitem__(self, key, value):
        super().__setitem__(key, value)
        if len(self) == self.most:
            raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.parametrize(("rounds", "parts"), [(1, 99), (99, 3), (2, 99)])
def test_an_interrupted_refinement_is_resumed(long_motion, monkeypatch, rounds, parts):
    monkeypatch.setattr(sequence, "windows", lambda count, length, overlap: windows(count, 10, 8))
    whole = refined(long_motion)
    checkpoint = RefineCheckpoint(Broken(rounds), Broken(parts))
    with pytest.raises(KeyboardInterrupt):
        refined(long_motion, checkpoint=checkpoint)
    matched, match = [], sequence.match_cameras

    def count(*arguments):
        matched.append(1)
        return match(*arguments)

    monkeypatch.setattr(sequence, "match_cameras", count)
    finished = []
    again = refined(
        long_motion,
        checkpoint=RefineCheckpoint(dict(checkpoint.rounds), dict(checkpoint.parts)),
        progress=finished.append,
    )
    assert len(finished) == 120
    # Each stored round saves 40 frames, each stored window ten, except those shared with its neighbours.
    assert len(matched) <= 120 - 40 * len(checkpoint.rounds) - (10 * parts - 8 if parts < 99 else 0)
    for one, other in zip(whole.poses, again.poses, strict=True):
        np.testing.assert_allclose(one.change_to(other), 0.0, atol=1e-9)
    np.testing.assert_allclose(again.covariance, whole.covariance, rtol=1e-6, atol=1e-12)


def test_a_frame_whose_silhouettes_are_ignored_follows_its_neighbours(motion):
    body, truth, levels, start = motion
    posed = [levels.at(f) for f in range(9)]

    class Wrong:
        """Levels of which one frame shows another."""

        def at(self, frame):
            return posed[0] if frame == 6 else posed[frame]

    fit = refine_sequence(range(9), start, body, Wrong(), rate=30, rounds=4, ignored_frames={6})
    assert worlds.joint_errors(PosedBody(body, fit.poses[6]), truth[6]).mean() < 0.02
    seen, unsupported_frames = (np.trace(fit.covariance[f][:3, :3]) for f in (5, 6))
    assert unsupported_frames > 2 * seen


@pytest.mark.slow
def test_pictures_between_two_frames_are_matched_at_their_own_instant():
    body, cameras, count = worlds.person(), worlds.ring(), 11
    # Every fourth pose of a motion is a frame; two cameras take their pictures two poses after it.
    poses = worlds.swing(body, 4 * count)
    truth = [PosedBody(body, pose) for pose in poses[: 4 * count : 4]]
    late = np.array([0.0, 0.5, 0.0, 0.5])
    seen = [worlds.silhouettes(PosedBody(body, poses[4 * f + 2]), cameras) for f in range(count)]
    masks = [
        [other[c] if late[c] else own for c, own in enumerate(worlds.silhouettes(posed, cameras))]
        for posed, other in zip(truth, seen, strict=True)
    ]
    levels = FrameLevels(cameras, lambda frame: masks[frame], 1.0)
    start = [posed.pose for posed in truth]

    def error(times):
        fit = refine_sequence(range(count), start, body, levels, rate=7.5, rounds=4, times=times)
        found = zip(fit.poses[1:-1], truth[1:-1], strict=True)
        return np.mean([worlds.joint_errors(PosedBody(body, pose), true) for pose, true in found])

    with_times = error(PictureTimes(np.repeat(late[:, None], count, axis=1)))
    assert with_times < 0.3 * error(None)
    # What remains is the error of silhouettes of whole pixels, about a millimetre each, and the third derivative.
    assert with_times < 0.006
