from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones, leg_bones, placed, problem, rigid_leg, thigh, turns

from marey.geometry import rotations
from marey.markers.data.clusters import AnatomicalCalibration
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import rigid
from marey.markers.data.trajectories import trajectories
from marey.markers.methods.estimator import skin_and_joints
from marey.motion.anatomical import euler_angles


def skin_trial(rng, frames=60, known=(0,), markers=(8, 7), size=0.006):
    """A leg whose skin slides and turns over each bone as a whole and in three modes of its own, smoothly."""
    bones = leg_bones(rng, frames)
    phase = 2 * np.pi * np.arange(frames)[:, None] / frames
    points = {}
    for (name, bone), count, sign in zip(bones.items(), markers, (1, -1), strict=True):
        places = sign * thigh(rng, count)
        about = places - places.mean(0)
        courses = np.sin(phase * rng.uniform(0.5, 2, 3) + rng.uniform(0, 6, 3))
        courses -= courses[0]
        turn = courses @ rng.normal(0, 0.5, (3, 3)) * size / 0.1
        shift = courses @ rng.normal(0, 0.7, (3, 3)) * size
        own = np.einsum("fr,rmk->fmk", courses, rng.normal(0, 0.6, (3, count, 3))) * size
        moved = np.cross(turn[:, None], about) + shift[:, None] + own
        points[name] = placed(*bone, places + moved) + rng.normal(0, 3e-4, (frames, count, 3))
    return problem(bones, points, frames=list(known)), bones


def errors(motion, bones):
    """Rotation vectors about the bone's axes and errors of the origin in the laboratory: (F, S, 6)."""
    out = []
    for name, (rotation, origin) in bones.items():
        estimated, place = motion.bone(name)
        out.append(np.concatenate([rotations.log(estimated.swapaxes(1, 2) @ rotation), origin - place], -1))
    return np.stack(out, 1)


@pytest.mark.parametrize("known", [[0], [0, 20], [0, 7, 20]])
def test_rigid_markers_give_the_true_bones(rng, known):
    leg, bones = leg_and_bones(rng, known=known)
    assert np.abs(errors(skin_and_joints(leg), bones)).max() < 1e-9


def test_the_known_postures_are_reproduced(rng):
    leg, bones = skin_trial(rng, known=(0, 30))
    there = errors(skin_and_joints(leg), bones)[[0, 30]]
    # The noise of the other frames does not reach them: they carry their own markers back.
    assert np.abs(there).max() < 1e-6


@pytest.mark.slow
def test_joints_and_skin_together_are_nearer_the_truth_than_rigid_clusters(rng):
    ratios = []
    for _ in range(4):
        for known in ((0,), (0, 15)):
            leg, bones = skin_trial(rng, frames=30, known=known)
            plain = rigid(replace(leg, calibration=first_posture(leg)))
            ours, theirs = (errors(motion, bones) for motion in (skin_and_joints(leg), plain))
            ratios.append(np.sqrt((knee(ours) ** 2).mean() / (knee(theirs) ** 2).mean()))
    assert max(ratios[::2]) < 1.0
    assert np.mean(ratios[1::2]) < 0.7


def knee(error):
    return error[:, 1, :3] - error[:, 0, :3]


def first_posture(leg):
    known = leg.calibration
    return AnatomicalCalibration(
        segments=known.segments, frames=known.frames[:1], rotation=known.rotation[:1], origin=known.origin[:1]
    )


@pytest.mark.slow
def test_stated_standard_deviations_contain_the_errors_of_simulated_trials(rng):
    held = []
    for each in range(8):
        leg, bones = skin_trial(rng, frames=30, known=(0,) if each % 2 else (0, 15))
        motion = skin_and_joints(leg)
        sd = np.concatenate([motion.rotation_sd, motion.origin_sd], -1)
        held.append((np.abs(errors(motion, bones)) <= 1.96 * sd).mean())
    # A trial has about five independent errors in each of its coordinates.
    assert 0.85 < np.mean(held) < 0.995


def test_a_single_segment_is_estimated_as_by_the_rigid_fit(rng):
    leg, _ = skin_trial(rng)
    alone = MarkerProblem(
        trajectories=leg.trajectories, clusters=leg.clusters[:1], calibration=leg.calibration, joints=leg.joints
    )
    motion = skin_and_joints(alone)
    assert motion.segments == ("thigh",)
    assert turns(motion.rotation[:, 0], rigid(alone).rotation[:, 0]).max() < np.radians(3)
    assert (motion.rotation_sd[1:] > rigid(alone).rotation_sd[1:]).mean() > 0.9


def test_frames_without_a_cluster_stay_empty_and_the_other_bone_is_estimated(rng):
    leg, _ = skin_trial(rng)
    points = np.array(leg.trajectories.points)
    points[10:15, :6] = np.nan
    points[20, 8] = np.nan
    motion = skin_and_joints(replace(leg, trajectories=trajectories(leg.trajectories.labels, points, 100.0)))
    expected = np.ones((60, 2), bool)
    expected[10:15, 0] = False
    np.testing.assert_array_equal(motion.answered, expected)
    assert np.isfinite(motion.covariance[motion.answered]).all()
    assert any("thigh: 5 of 60 frames" in note for note in motion.notes)


def test_two_markers_swapped_in_one_frame_make_that_frame_uncertain_and_change_the_others_within_their_uncertainty(rng):
    leg, _ = skin_trial(rng)
    points = np.array(leg.trajectories.points)
    points[25, [0, 7]] = points[25, [7, 0]]
    swapped = skin_and_joints(replace(leg, trajectories=trajectories(leg.trajectories.labels, points, 100.0)))
    plain = skin_and_joints(leg)
    others = np.arange(60) != 25
    assert (swapped.rotation_sd[25, 0] > 2 * plain.rotation_sd[25, 0]).all()
    np.testing.assert_allclose(swapped.rotation_sd[others], plain.rotation_sd[others], rtol=0.5, atol=1e-9)
    changed = turns(swapped.rotation[others], plain.rotation[others])
    assert (changed <= np.linalg.norm(plain.rotation_sd[others], axis=-1)).all()


def test_a_single_frame_and_postures_known_twice_are_estimated(rng):
    leg, bones = leg_and_bones(rng, frames=1)
    assert np.abs(errors(skin_and_joints(leg), bones)).max() < 1e-9
    leg, bones = skin_trial(rng, known=(0, 0))
    assert skin_and_joints(leg).answered.all()


def test_the_model_of_the_skin_is_reported(rng):
    leg, _ = skin_trial(rng)
    notes = skin_and_joints(leg).notes
    assert any(note.startswith("thigh: the skin is estimated to slide by") for note in notes)
    assert any("is rigid within its noise" in note for note in skin_and_joints(rigid_leg(rng)).notes)


def test_a_knee_that_rotates_far_is_reported_and_followed(rng):
    bones = leg_bones(rng, 60)
    course = 0.4 * (np.cos(np.linspace(0, 4 * np.pi, 60)) - 1)
    turn = rotations.about(np.array([0.0, 1.0, 0.0]), course)
    bones["shank"] = (bones["shank"][0] @ turn, bones["shank"][1])
    points = {
        name: placed(*bone, sign * thigh(rng, 8)) + rng.normal(0, 3e-4, (60, 8, 3))
        for (name, bone), sign in zip(bones.items(), (1, -1), strict=True)
    }
    motion = skin_and_joints(problem(bones, points, frames=[0]))
    [note] = [note for note in motion.notes if "more than is usual" in note]
    assert note.startswith("thigh and shank: the rotation varies")
    # Noise of 0.3 mm on eight markers about 10 cm apart, in a frame and in the reference.
    assert np.abs(errors(motion, bones)[..., :3]).max() < 0.02


def test_axes_that_are_not_anatomical_are_reported(rng):
    leg, _ = skin_trial(rng)
    turned = rotations.about(np.array([0.0, 1.0, 0.0]), np.array(np.pi / 2))
    known = leg.calibration
    motion = skin_and_joints(replace(leg, calibration=replace(known, rotation=known.rotation @ turned)))
    assert any("does not rotate about the bones' Z axes" in note for note in motion.notes)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "one", "two"), [("ottawa_walking", 0.85, 0.65), ("unibo_step_up", 0.75, 0.55)])
def test_real_skin_over_true_bones_is_followed_better_than_by_rigid_clusters(shared: Path, name, one, two):
    with np.load(shared / "data" / "markers" / "sta" / f"{name}.npz") as stored:
        truth = dict(stored)
    bones = {s: (truth[f"{s}_rotation"], truth[f"{s}_origin"] / 1000) for s in ("thigh", "shank")}
    points = {s: placed(*bones[s], truth[f"{s}_markers"] / 1000) for s in bones}
    flexion = [angles(*(r for r, _ in bones.values()))[:, 0]]
    farthest = int(np.abs(flexion[0] - flexion[0][0]).argmax())
    plain = knee_error(rigid(trial(truth, bones, points, [0])), bones)
    for known, most in (([0], one), ([0, farthest], two)):
        assert knee_error(skin_and_joints(trial(truth, bones, points, known)), bones) < most * plain


def trial(truth, bones, points, known):
    made = problem(bones, points, frames=known)
    labels = made.trajectories.labels
    return replace(made, trajectories=trajectories(labels, made.trajectories.points, float(truth["rate"])))


def angles(first, second):
    return np.unwrap(euler_angles(first.swapaxes(1, 2) @ second, "ZXY"), axis=0)


def knee_error(motion, bones):
    true = angles(*(rotation for rotation, _ in bones.values()))
    return np.sqrt(((angles(motion.rotation[:, 0], motion.rotation[:, 1]) - true) ** 2).mean())


def test_a_segment_that_no_posture_shows_stays_empty_and_the_other_is_estimated(rng):
    leg, _ = skin_trial(rng)
    points = np.array(leg.trajectories.points)
    points[0, 1:8] = np.nan
    motion = skin_and_joints(replace(leg, trajectories=trajectories(leg.trajectories.labels, points, 100.0)))
    assert motion.segments == ("thigh", "shank")
    np.testing.assert_array_equal(motion.answered.sum(0), [0, 60])
    assert any("thigh: skipped" in note for note in motion.notes)


def test_a_posture_in_which_one_bone_is_unknown_serves_the_other(rng):
    leg, bones = skin_trial(rng, known=(0, 30))
    known = leg.calibration
    rotation, origin = np.array(known.rotation), np.array(known.origin)
    rotation[1, 1], origin[1, 1] = np.nan, np.nan
    motion = skin_and_joints(replace(leg, calibration=replace(known, rotation=rotation, origin=origin)))
    assert motion.answered.all()
    there = errors(motion, bones)
    assert np.abs(there[0]).max() < 1e-6
    assert np.abs(there[30, 0]).max() < 1e-6
    assert np.abs(there[30, 1]).max() > 1e-4
