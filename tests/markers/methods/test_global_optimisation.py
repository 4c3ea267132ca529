"""Global optimisation over a chain made from the trial: derivatives, truth recovered, joints of one to six degrees."""

from dataclasses import replace

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import rigid
from marey.markers.data.trajectories import trajectories
from marey.markers.methods.chain import ChainJoint, JointPlace, joint_gap
from marey.markers.methods.global_optimisation import (
    GlobalOptimisationSettings,
    global_ball,
    global_hinge,
    global_soft,
    optimise_chain,
)
from marey.markers.methods.methods import METHODS

HIP, KNEE = np.array([0.0, -0.1, 0.08]), np.array([0.0, -0.4, 0.0])
AXIS = np.array([0.1, -0.1, 1.0]) / np.linalg.norm([0.1, -0.1, 1.0])


def moving(frames=40, *, knee=1):
    """Give rotations (F, 3, 3, 3) and origins (F, 3, 3) of pelvis, thigh and shank with a hinge or a ball as knee."""
    phase = np.linspace(0, 2 * np.pi, frames)[:, None]
    pelvis = rotations.exp(np.array([0.1, 0.3, 0.1]) * np.sin(phase + [0, 1, 2]))
    place = np.concatenate([phase * 0.2, 0.9 + 0.03 * np.sin(2 * phase), 0.02 * np.cos(phase)], 1)
    thigh = pelvis @ rotations.exp(np.array([0.15, 0.2, 0.5]) * np.sin(phase + [1, 3, 0]))
    bend = -0.6 + 0.6 * np.cos(phase)
    turn = AXIS * bend if knee == 1 else AXIS * bend + np.array([0.1, 0.15, 0.0]) * np.sin(phase + [2, 0, 0])
    shank = thigh @ rotations.exp(turn)
    hip = place + pelvis @ HIP
    return np.stack([pelvis, thigh, shank], 1), np.stack([place, hip, hip + thigh @ KNEE], 1)


def filmed(bones, *, noise=0.0, count=6, joints=(("pelvis", "thigh"), ("thigh", "shank")), postures=(0,)):
    """Give the problem of a cluster of markers on each bone."""
    rotation, origin = bones
    rng = np.random.default_rng(5)
    names = ("pelvis", "thigh", "shank")
    on_bone = rng.normal(scale=0.06, size=(3, count, 3)) + np.array([0.0, -0.1, 0.0])
    points = np.einsum("fsij,smj->fsmi", rotation, on_bone) + origin[:, :, None]
    points = points + noise * rng.normal(size=points.shape)
    labels = [f"{name}_{i}" for name in names for i in range(count)]
    at = list(postures)
    return MarkerProblem(
        trajectories=trajectories(labels, points.reshape(len(rotation), -1, 3), 100.0),
        clusters=tuple(
            Cluster(segment=n, labels=tuple(labels[s * count : (s + 1) * count])) for s, n in enumerate(names)
        ),
        calibration=AnatomicalCalibration(
            segments=names, frames=np.array(at), rotation=rotation[at], origin=origin[at]
        ),
        joints=joints, noise_m=max(noise, 1e-4),
    )  # fmt: skip


def without(problem, frames, labels):
    """Give the problem without some markers in some frames."""
    points = np.array(problem.trajectories.points)
    index = [problem.trajectories.labels.index(label) for label in labels]
    points[np.ix_(frames, index)] = np.nan
    return replace(problem, trajectories=trajectories(problem.trajectories.labels, points, 100.0))


def turn_error(motion, bones, segment=2):
    between = np.swapaxes(motion.rotation[:, segment], 1, 2) @ bones[0][:, segment]
    return np.linalg.norm(rotations.log(between), axis=-1)


@pytest.mark.parametrize("scale", [1e-2, 1.0, 1e2])
@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 5, 6])
def test_the_gap_of_a_joint_and_its_derivatives_are_differences_at_any_scale_of_length(degrees, scale, rng):
    joint = ChainJoint(parent="a", child="b", degrees_of_freedom=degrees, sd_m=0.5 * scale, sd_rad=0.3)
    held = np.linalg.qr(rng.normal(size=(3, 3)))[0][: joint.constrained_translations]
    units = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    place = JointPlace(
        *(scale * rng.normal(size=(2, 3))), units[0], (units[0] + units[1]) / np.sqrt(2), held,
        rotations.exp(rng.normal(size=3)),
    )  # fmt: skip
    parent, child = ((rotations.exp(0.6 * rng.normal(size=(4, 3))), scale * rng.normal(size=(4, 3))) for _ in range(2))
    _, jacobian, shared = joint_gap(joint, place, parent, child, 1e-4)

    def at(step):
        moved = [
            (r @ rotations.exp(s[:3]), o + s[3:])
            for (r, o), s in zip((parent, child), step[:12].reshape(2, 6), strict=True)
        ]
        return joint_gap(joint, place.moved(step[12:]), *moved, 1e-4)[0]

    lengths = np.r_[[1] * 3, [scale] * 3, [1] * 3, [scale] * 3, [scale] * 6, [1] * 4]
    for k, size in enumerate(lengths):
        step = 1e-6 * size * np.eye(22)[k]
        difference = (at(step) - at(-step)) / (2e-6 * size)
        analytic = jacobian[..., k] if k < 12 else shared[..., k - 12]
        assert np.allclose(analytic * size, difference * size, atol=1e-7)


def test_free_and_constrained_degrees_of_a_joint_add_up_to_six():
    for degrees in range(1, 6):
        joint = ChainJoint(parent="a", child="b", degrees_of_freedom=degrees)
        assert joint.constrained_translations + joint.constrained_rotations + degrees == 6
    assert ChainJoint(parent="a", child="b", degrees_of_freedom=6).constrained_translations == 0
    assert ChainJoint(parent="a", child="b", degrees_of_freedom=6, sd_m=0.005).constrained_translations == 3


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 5, 6])
def test_rigid_markers_give_the_true_bones_for_every_model_of_the_knee(degrees):
    bones = moving()
    problem = filmed(bones)
    joints = [
        ChainJoint(parent="pelvis", child="thigh"),
        ChainJoint(parent="thigh", child="shank", degrees_of_freedom=degrees),
    ]
    found = optimise_chain(problem, joints)
    assert np.abs(found.bones.rotation - bones[0]).max() < 1e-9
    assert np.abs(found.bones.origin - bones[1]).max() < 1e-9
    assert np.allclose(found.centres_in_parent[0], HIP, atol=1e-5)
    if degrees == 3:
        # A knee that only bends shows its centre across its axis.
        off = found.centres_in_parent[1] - KNEE
        assert np.linalg.norm(np.cross(off, AXIS)) < 1e-5
    if degrees == 1:
        assert np.abs(found.axes[1] @ AXIS) > 1 - 1e-12


@pytest.mark.parametrize("knee", [1, 3])
def test_joints_make_noisy_clusters_better(knee):
    bones = moving(60, knee=knee)
    problem = replace(filmed(bones, noise=0.004, count=4), degrees_of_freedom=(3, knee))
    alone, together = rigid(problem), global_ball(problem)
    assert np.sqrt((turn_error(together, bones)[1:] ** 2).mean()) < 0.95 * np.sqrt(
        (turn_error(alone, bones)[1:] ** 2).mean()
    )


@pytest.mark.slow
def test_stated_standard_deviations_contain_the_errors_due_to_noise():
    bones = moving(80)
    # Many known postures, so that the places of the markers on the bones are hardly noisy.
    problem = replace(filmed(bones, noise=0.002, postures=range(0, 80, 4)), degrees_of_freedom=(3, 1))
    off = np.arange(80) % 4 > 0
    found = optimise_chain(
        replace(problem, calibration=problem.calibration),
        [ChainJoint(parent="pelvis", child="thigh"), ChainJoint(parent="thigh", child="shank", degrees_of_freedom=1)],
    ).bones
    turns = rotations.log(np.swapaxes(found.rotation, -1, -2) @ bones[0])
    held = np.concatenate(
        [np.abs(turns) < 1.96 * found.rotation_sd, np.abs(found.origin - bones[1]) < 1.96 * found.origin_sd]
    )
    assert 0.88 < held.reshape(2, 80, -1)[:, off].mean() < 0.99


@pytest.mark.slow
def test_common_skin_motion_is_included_with_the_size_that_the_markers_show():
    bones = moving(80)
    problem = filmed(bones, noise=0.001, postures=range(0, 80, 4))
    rng = np.random.default_rng(9)
    slow = np.sin(np.linspace(0, 6, 80)[:, None, None] + rng.uniform(0, 6, (3, 1, 3)).reshape(1, -1, 3).repeat(6, 1))
    own = np.sin(np.linspace(0, 6, 80)[:, None, None] + rng.uniform(0, 6, (1, 18, 3)))
    points = problem.trajectories.points + 0.008 * slow + 0.008 * own
    skin = replace(problem, trajectories=trajectories(problem.trajectories.labels, points, 100.0))
    found = global_ball(skin)
    held = [
        np.abs(rotations.log(np.swapaxes(found.rotation, -1, -2) @ bones[0])) < 1.96 * found.rotation_sd,
        np.abs(found.origin - bones[1]) < 1.96 * found.origin_sd,
    ]
    assert np.mean(held) > 0.8


def test_a_bone_with_two_markers_is_known_through_its_joint_and_one_without_any_is_not():
    bones = moving(60, knee=3)
    shank = [f"shank_{i}" for i in range(6)]
    problem = without(without(filmed(bones), [10, 11], shank[2:]), [30, 31], shank)
    found = global_ball(problem)
    answered = found.answered
    assert answered[:, :2].all()
    assert np.flatnonzero(~answered[:, 2]).tolist() == [30, 31]
    assert turn_error(found, bones)[[10, 11]].max() < 1e-5
    assert any("shank: 2 of 60 frames have no result" in note for note in found.notes)


def test_a_given_centre_and_axis_are_kept():
    problem = filmed(moving())
    knee = ChainJoint(parent="thigh", child="shank", degrees_of_freedom=1, centre=KNEE + 0.01, axis=2 * AXIS)
    found = optimise_chain(problem, [knee])
    assert np.allclose(found.centres_in_parent[0], KNEE + 0.01)
    assert np.allclose(found.axes[0], AXIS)


def test_a_soft_joint_lies_between_none_and_a_fast_one():
    bones = moving(60, knee=3)
    # The skin of the shank slides up and down with the bend.
    problem = filmed(bones, noise=0.004)
    points = np.array(problem.trajectories.points)
    points[:, 12:] += 0.02 * np.sin(np.linspace(0, 2 * np.pi, 60))[:, None, None] * np.array([0.0, 1.0, 0.0])
    slid = replace(problem, trajectories=trajectories(problem.trajectories.labels, points, 100.0))

    def come_apart(**joint):
        found = optimise_chain(slid, [ChainJoint(parent="thigh", child="shank", **joint)]).bones
        ends = found.rotation[:, 1] @ KNEE + found.origin[:, 1] - found.origin[:, 2]
        return np.sqrt((ends**2).sum(-1).mean())

    fast, none = come_apart(centre=KNEE), come_apart(degrees_of_freedom=6)
    soft = come_apart(degrees_of_freedom=6, sd_m=2e-3, centre=KNEE)
    # The known posture's noise is in the place of the centre.
    assert 2 * fast < soft < 0.9 * none


def test_several_postures_let_the_places_follow_the_joint():
    bones = moving(60)
    bend = np.linspace(0, 2 * np.pi, 60)
    problem = filmed(bones, postures=(0, 29))
    points = np.array(problem.trajectories.points)
    points[:, 12] += np.einsum("fij,j->fi", bones[0][:, 2], [0.0, 0.02, 0.0]) * (1 - np.cos(bend))[:, None] / 2
    slid = replace(problem, trajectories=trajectories(problem.trajectories.labels, points, 100.0))
    assert turn_error(global_ball(slid), bones).max() < 1e-3


@pytest.mark.slow
def test_the_settings_reach_the_estimate():
    problem = filmed(moving(40), noise=0.002)
    usual = global_ball(problem)
    assert global_ball(problem, GlobalOptimisationSettings(largest_sd=1e-9)).answered.sum() == 0
    np.testing.assert_array_equal(global_ball(problem, GlobalOptimisationSettings()).origin, usual.origin)
    loose = global_soft(problem, GlobalOptimisationSettings(soft_sd_m=0.1))
    assert np.abs(loose.origin - global_soft(problem).origin).max() > 1e-6


def test_the_registered_methods_are_these():
    problem = filmed(moving(20))
    for name, function in (("global", global_ball), ("global_hinge", global_hinge), ("global_soft", global_soft)):
        assert METHODS[name].load() is function
        assert METHODS[name].missing_requirement(replace(problem, joints=())) == "needs a joint between two segments"
        assert function(problem).answered.all()


@pytest.mark.parametrize("frames", [range(20), [0]], ids=["in no frame", "not in the known posture"])
@pytest.mark.parametrize("method", ["global", "global_hinge", "global_soft"])
def test_a_segment_whose_markers_are_not_in_a_known_posture_is_reported(frames, method):
    problem = replace(filmed(moving(20)), degrees_of_freedom=(3, 1))
    unseen = without(problem, frames, [f"shank_{i}" for i in range(6)])
    with pytest.raises(MareyError, match=r"in a known posture, which shows none of shank\."):
        METHODS[method].load()(unseen)


def test_what_cannot_be_a_joint_is_reported():
    problem = filmed(moving(20))
    with pytest.raises(MareyError, match="connects 'foot', which has no markers"):
        optimise_chain(problem, [ChainJoint(parent="shank", child="foot")])
    with pytest.raises(MareyError, match="needs a joint"):
        optimise_chain(problem, [])
    with pytest.raises(MareyError, match="a joint has 1 to 6"):
        ChainJoint(parent="a", child="b", degrees_of_freedom=0)
    with pytest.raises(MareyError, match="sd_m -1"):
        ChainJoint(parent="a", child="b", sd_m=-1)
    with pytest.raises(MareyError, match="axis of the joint of a and b is not a finite 3-vector"):
        ChainJoint(parent="a", child="b", axis=np.zeros(3))
    with pytest.raises(MareyError, match="No joint is a hinge"):
        global_hinge(replace(problem, joints=(("pelvis", "thigh"),)))


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 5, 6])
def test_a_trial_of_one_frame_is_its_posture(degrees):
    bones = moving(40)
    problem = filmed((bones[0][:1], bones[1][:1]))
    knee = ChainJoint(parent="thigh", child="shank", degrees_of_freedom=degrees)
    found = optimise_chain(problem, [knee]).bones
    assert np.abs(found.rotation - bones[0][:1]).max() < 1e-9
