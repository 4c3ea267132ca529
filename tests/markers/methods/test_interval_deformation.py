from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones, leg_bones, placed, problem, rigid_leg, smooth_motion, thigh, turns

from marey.errors import SettingProblem
from marey.geometry import rotations
from marey.markers.data.cluster_data import cluster_data
from marey.markers.data.rigid_fit import rigid
from marey.markers.data.setup import SkinChoice
from marey.markers.methods import skin_forms
from marey.markers.methods.interval_deformation import (
    bone_motion_of,
    candidate_forms,
    choose_form,
    deform,
    interval,
)
from marey.markers.methods.skin_forms import SkinForm

NOISE = 2e-4
SKIN = 8e-3


def moving_cluster(rng, functions, moving, frames=200, markers=12):
    """A thigh whose markers move by 8 mm in root mean square, each by the functions that it has."""
    rotation, origin = smooth_motion(rng, frames)
    vectors = rng.normal(size=(markers, functions.shape[1], 3)) * moving[..., None]
    skin = np.einsum("fk,mki->fmi", functions - functions[0], vectors)
    size = np.sqrt((skin**2).sum(-1).mean(0))
    skin *= SKIN / np.sqrt((size[size > 0] ** 2).mean())
    points = placed(rotation, origin, thigh(rng, markers) + skin) + rng.normal(0, NOISE, (frames, markers, 3))
    trial = problem({"thigh": (rotation, origin)}, {"thigh": points}, frames=[0], noise_m=NOISE)
    return trial, cluster_data(trial, trial.clusters[0]), rotation, origin


def rms(turn):
    return np.sqrt((turn**2).mean())


@pytest.mark.parametrize("seed", range(3))
def test_where_markers_swing_in_phases_of_their_own_nine_tenths_of_the_error_go(seed):
    rng = np.random.default_rng(seed)
    phase = 2 * np.pi * np.arange(200)[:, None] / 100 + rng.uniform(0, 2 * np.pi, 12)
    trial, data, rotation, _ = moving_cluster(rng, np.sin(phase), np.eye(12))
    form = SkinForm(name="own phases", functions=np.sin(phase))
    found = deform(data, form, NOISE, moving=np.eye(12, dtype=bool))
    # The turn of a frame is itself uncertain by the noise over the cluster's radius: 0.08 degrees.
    assert rms(turns(found.fit.rotation, rotation)) < 0.1 * rms(turns(rigid(trial).rotation[:, 0], rotation)) + 1.5e-3
    assert not found.unobserved


def test_shifts_common_to_all_markers_are_not_observed_and_is_reported(rng):
    phase = 2 * np.pi * np.arange(300)[:, None] / 100
    trial, data, rotation, origin = moving_cluster(rng, np.sin(phase), np.ones((12, 1)), frames=300)
    found = deform(data, SkinForm(name="one sinusoid", functions=np.sin(phase)), NOISE)
    assert found.unobserved == ("translation along x", "translation along y", "translation along z")
    assert rms(turns(found.fit.rotation, rotation)) < 0.3 * rms(turns(rigid(trial).rotation[:, 0], rotation))
    motion = bone_motion_of(found)
    assert any("not observed and count as the bone's" in note for note in motion.notes)
    held = np.abs(motion.origin[1:, 0] - origin[1:]) < 1.96 * motion.origin_sd[1:, 0]
    assert held.mean() > 0.8  # what is not seen is stated as large as the motions that are


def test_a_turn_about_two_static_markers_is_not_observed_and_is_reported(rng):
    phase = 2 * np.pi * np.arange(40)[:, None] / 40
    moving = np.ones((6, 1), bool)
    moving[[0, 5]] = False
    _, data, *_ = moving_cluster(rng, 1e-3 * np.sin(phase), moving, frames=40, markers=6)
    functions = SkinForm(name="slow", functions=np.sin(phase))
    for still, expected in (([0, 5], 1), ([0, 2, 5], 0)):
        moves = np.ones((6, 1), bool)
        moves[still] = False
        share = deform(data, functions, 50 * NOISE, moving=moves).unobserved_ratios
        assert len(share) == expected
        assert all(value > 0.5 for value in share.values())


def test_the_stated_rotations_contain_the_errors(rng):
    phase = 2 * np.pi * np.arange(200)[:, None] / 100
    functions = np.concatenate([np.sin(phase), np.cos(phase)], 1)
    moving = np.ones((12, 2), bool)
    moving[[0, 5, 11]] = False
    _, data, rotation, _ = moving_cluster(rng, functions, moving)
    motion = bone_motion_of(deform(data, SkinForm(name="swing", functions=functions), NOISE, moving=moving))
    error = rotations.log(np.swapaxes(motion.rotation[1:, 0], 1, 2) @ rotation[1:])
    assert 0.85 < (np.abs(error) < 1.96 * motion.rotation_sd[1:, 0]).mean() <= 1


@pytest.mark.slow
def test_the_criterion_finds_the_form_that_the_markers_have(rng):
    phase = 2 * np.pi * np.arange(200)[:, None] / 100
    swing = SkinForm(name="swing", functions=np.concatenate([np.sin(phase), np.cos(phase)], 1))
    time = np.arange(200) / 100
    offered = [skin_forms.constant(200), skin_forms.linear_in_time(time), swing, skin_forms.spline(time, 4)]
    _, data, *_ = moving_cluster(rng, swing.functions, np.ones((12, 2)))
    assert choose_form(data, offered, NOISE).form.name == "swing"
    rotation, origin = smooth_motion(rng, 200)
    points = placed(rotation, origin, thigh(rng, 12)) + rng.normal(0, NOISE, (200, 12, 3))
    still = problem({"thigh": (rotation, origin)}, {"thigh": points}, frames=[0], noise_m=NOISE)
    assert choose_form(cluster_data(still, still.clusters[0]), offered, NOISE).form.name == "constant"


def test_a_second_known_posture_shows_what_all_markers_do_together_with_the_joint(rng):
    bones = leg_bones(rng, 60)
    flexion = turns(bones["thigh"][0], bones["shank"][0])
    slide = flexion[:, None, None] * np.array([0.0, -0.02, 0.004])
    points = {
        "thigh": placed(*bones["thigh"], thigh(rng, 9) + slide) + rng.normal(0, NOISE, (60, 9, 3)),
        "shank": placed(*bones["shank"], -thigh(rng, 7)) + rng.normal(0, NOISE, (60, 7, 3)),
    }
    both = interval(problem(bones, points, frames=[0, 30], noise_m=NOISE))
    one = rigid(problem(bones, points, frames=[0], noise_m=NOISE))
    left, plain = (np.linalg.norm(m.origin[:, 0] - bones["thigh"][1], axis=-1) for m in (both, one))
    assert rms(left) < 0.15 * rms(plain)


def test_missing_markers_and_empty_frames_are_left_out_and_reported(rng):
    leg, bones = leg_and_bones(rng)
    points = leg.trajectories.points.copy()
    points[4, :8] = np.nan
    points[9, 3] = np.nan
    motion = interval(replace(leg, trajectories=replace(leg.trajectories, points=points)))
    assert np.flatnonzero(~motion.answered[:, 0]).tolist() == [4]
    assert turns(motion.rotation[[3, 9], 0], bones["thigh"][0][[3, 9]]).max() < 1e-9
    assert any("1 of 40 frames" in note for note in motion.notes)


def test_a_long_trial_is_learned_from_some_frames_and_estimated_in_all(rng):
    phase = 2 * np.pi * np.arange(200)[:, None] / 100
    data = moving_cluster(rng, np.sin(phase), np.ones((12, 1)))[1]
    form = SkinForm(name="one sinusoid", functions=np.sin(phase))
    some, every = (deform(data, form, NOISE, most_frames=most) for most in (100, None))
    assert rms(turns(some.fit.rotation, every.fit.rotation)) < 3e-3
    assert len(bone_motion_of(some)) == 200


def test_a_specified_form_is_used(rng):
    leg = rigid_leg(rng)
    bump = np.exp(-(((leg.trajectories.time - 0.2) / 0.05) ** 2))[:, None]
    forms = {
        "as in the given file": SkinChoice(form="file", functions=bump),
        "sinusoid of 0.30 s": SkinChoice(form="sinusoid", period_s=0.3),
        "spline of 3 pieces": SkinChoice(form="spline", pieces=3),
        "linear in time": SkinChoice(form="time"),
        "linear in the joint's rotation": SkinChoice(form="rotation"),
        "constant": SkinChoice(form="constant"),
    }
    for name, choice in forms.items():
        motion = interval(replace(leg, skin={"thigh": choice}))
        assert any(note == f"thigh: form of the skin motion: {name}." for note in motion.notes)


def test_markers_without_skin_motion_show_the_bone(rng):
    phase = 2 * np.pi * np.arange(200)[:, None] / 100
    moving = np.ones((12, 2))
    moving[[0, 5, 11]] = 0
    trial, _, rotation, _ = moving_cluster(rng, np.concatenate([np.sin(phase), np.cos(phase)], 1), moving)
    choice = SkinChoice(form="sinusoid", period_s=1.0, still=("thigh_00", "thigh_05", "thigh_11"))
    motion = interval(replace(trial, skin={"thigh": choice}))
    assert rms(turns(motion.rotation[:, 0], rotation)) < 0.2 * rms(turns(rigid(trial).rotation[:, 0], rotation))
    assert not any("not observed" in note for note in motion.notes)


def test_a_form_that_the_trial_cannot_have_is_an_error(rng):
    leg = rigid_leg(rng)
    for choice, wrong in (
        (SkinChoice(form="file", functions=np.ones((3, 1))), "should return"),
        (SkinChoice(form="sinusoid"), "Specify period_s"),
        (SkinChoice(form="time", still=("heel",)), "missing from the trial: heel"),
    ):
        with pytest.raises(SettingProblem, match=wrong):
            interval(replace(leg, skin={"thigh": choice}))


def test_several_postures_offer_only_what_carries_over_from_them(rng):
    for known, expected in (([0], 4), ([0, 20], 2)):
        leg = rigid_leg(rng, known=known)
        assert len(candidate_forms(leg, "thigh", rigid(leg))) == expected
