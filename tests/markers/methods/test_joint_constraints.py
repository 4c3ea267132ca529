from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_bones

from marey.geometry import rotations
from marey.markers.methods.joint_constraints import (
    ClusterPose,
    JointConstraintSettings,
    JointLaxity,
    JointVariation,
    KnownJoint,
    angles_wrt_turns,
    initial_centres,
    is_anatomical,
    joint_rows,
    krige,
    laxity,
    refined_centres,
)
from marey.motion.anatomical import euler_angles

STEP = 1e-6


def leg(rng, frames=12, spread=0.05):
    """Two clusters with the true poses of the bones, and the knee between them, known in frames 0 and 6."""
    bones = leg_bones(rng, frames)
    prior = np.broadcast_to(np.eye(6) * spread**2, (frames, 6, 6))
    centres = (np.array([0.02, 0.2, -0.01]), np.array([0.0, -0.2, 0.03]))
    clusters = [
        ClusterPose(rotation=r, origin=o, centre=centre, prior=prior)
        for (r, o), centre in zip(bones.values(), centres, strict=True)
    ]
    known = np.array([0, 6])
    flexion = euler_angles(np.swapaxes(clusters[0].rotation, 1, 2) @ clusters[1].rotation, "ZXY")[:, 0]
    joint = KnownJoint(
        parent=0, child=1, laxity=laxity("thigh", "shank"), frames=known, turn=flexion, time=np.arange(frames) / 10,
        parent_pose=(clusters[0].rotation[known], clusters[0].origin[known]),
        child_pose=(clusters[1].rotation[known], clusters[1].origin[known]), anatomical=True,
    )  # fmt: skip
    return clusters, joint


def test_the_angles_change_as_their_derivative_predicts(rng):
    relative = rotations.exp(rng.normal(0, 0.4, (7, 3)))
    wrt = angles_wrt_turns(relative, euler_angles(relative, "ZXY"))
    for axis in range(6):
        turn = rotations.exp(STEP * np.eye(3)[axis % 3])
        moved = [turn.T @ relative, turn @ relative] if axis < 3 else [relative @ turn, relative @ turn.T]
        difference = (euler_angles(moved[0], "ZXY") - euler_angles(moved[1], "ZXY")) / (2 * STEP)
        np.testing.assert_allclose(wrt[..., axis], difference, atol=1e-8)


def test_the_rows_change_as_their_derivative_predicts(rng):
    clusters, joint = leg(rng)
    centres = (rng.normal(0, 0.1, 3), rng.normal(0, 0.1, 3))
    steps = np.zeros((12, 2, 6))
    rows = joint_rows(joint, clusters, steps, centres)
    for axis in range(12):
        ends = []
        for sign in (1, -1):
            there = steps.copy()
            there[:, axis // 6, axis % 6] += sign * STEP
            ends.append(joint_rows(joint, clusters, there, centres).residual)
        np.testing.assert_allclose(rows.wrt[..., axis], (ends[1] - ends[0]) / (2 * STEP), atol=1e-8)


def test_a_true_hinge_has_no_residual_and_known_postures_fix_it_exactly(rng):
    clusters, joint = leg(rng)
    rows = joint_rows(joint, clusters, np.zeros((12, 2, 6)), (np.zeros(3), np.zeros(3)))
    np.testing.assert_allclose(rows.residual, 0, atol=1e-12)
    np.testing.assert_allclose(rows.sd[joint.frames], 0, atol=1e-7)
    assert rows.sd[3].min() > 1e-3


def test_a_frame_without_one_of_the_bones_has_no_equations(rng):
    clusters, joint = leg(rng)
    rotation = np.array(clusters[1].rotation)
    rotation[4] = np.nan
    clusters[1] = ClusterPose(
        rotation=rotation, origin=clusters[1].origin, centre=clusters[1].centre, prior=clusters[1].prior
    )
    rows = joint_rows(joint, clusters, np.zeros((12, 2, 6)), (np.zeros(3), np.zeros(3)))
    assert not rows.wrt[4].any()
    assert not rows.residual[4].any()
    assert np.isfinite(rows.residual).all()


def test_the_centre_of_the_joint_is_found_where_it_is(rng):
    clusters, joint = leg(rng, frames=60, spread=1e-3)
    guess = initial_centres(joint, clusters)
    centres = guess
    for _ in range(3):
        centres = refined_centres(joint, clusters, np.zeros((60, 2, 6)), centres, guess[0])
    # The position along the hinge's axis is not determined.
    for centre in centres:
        assert np.abs(centre[:2]).max() < 2e-3


def test_a_joint_that_turns_about_another_axis_does_not_count_as_a_knee(rng):
    angle = np.linspace(0, 1, 20)
    assert is_anatomical(rotations.about(np.array([0.0, 0.0, 1.0]), angle))
    assert not is_anatomical(rotations.about(np.array([1.0, 0.0, 0.0]), angle))
    assert is_anatomical(rotations.about(np.array([1.0, 0.0, 0.0]), 0.1 * angle))
    assert is_anatomical(np.full((3, 3, 3), np.nan))


@pytest.mark.parametrize("name", ["adduction", "rotation"])
def test_a_knee_whose_axes_are_not_anatomical_keeps_its_angles_free(rng, name):
    clusters, joint = leg(rng)
    free = KnownJoint(**{**joint.__dict__, "anatomical": False})
    there = np.zeros((12, 2, 6)), (np.zeros(3), np.zeros(3))
    assert getattr(joint.laxity, name) is not None
    assert joint_rows(free, clusters, *there).residual.shape[1] == 3
    assert joint_rows(joint, clusters, *there).residual.shape[1] == 5


def linear(first, second):
    return np.abs(np.asarray(first)[:, None] - np.asarray(second))


def test_known_frames_get_themselves_back_and_weights_sum_to_one(rng):
    place, known = rng.uniform(0, 3, 30), np.array([4, 11, 20])
    weights, variance = krige(linear(place, place[known]), linear(place[known], place[known]))
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(weights[known], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(variance[known], 0, atol=1e-12)


def test_independent_steps_are_interpolated_linearly_and_held_beyond():
    place, known = np.array([-1.0, 0.0, 0.25, 1.0, 3.0]), np.array([0.0, 1.0])
    weights, variance = krige(linear(place, known), linear(known, known))
    np.testing.assert_allclose(weights[:, 1], [0, 0, 0.25, 1, 1], atol=1e-12)
    # Half the variance per step: a walk of length t has variance 2t, a bridge between ends 1 apart 2t(1 - t).
    np.testing.assert_allclose(variance[2], 2 * 0.25 * 0.75, atol=1e-12)


def test_one_known_frame_applies_everywhere_with_the_variance_of_the_difference():
    weights, variance = krige(np.array([[0.0], [2.0]]), np.zeros((1, 1)))
    np.testing.assert_allclose(weights, 1)
    np.testing.assert_allclose(variance, [0, 4], atol=1e-12)


def test_a_frame_known_twice_shares_its_weight():
    known = np.array([0.0, 0.0, 1.0])
    weights, _ = krige(linear([0.0, 0.5], known), linear(known, known))
    np.testing.assert_allclose(weights, [[0.5, 0.5, 0], [0.25, 0.25, 0.5]], atol=1e-12)


def test_a_joint_is_known_on_either_side_and_by_its_bones():
    knee = laxity("thigh", "shank")
    assert knee.adduction is not None
    assert knee.rotation is not None
    assert laxity("left_thigh", "left_shank") == laxity("femur", "tibia") == knee
    assert laxity("right_upperarm", "right_forearm").rotation is None


def test_the_settings_give_the_laxity_of_a_joint_and_the_prior_of_its_centre(rng):
    stiff = JointLaxity(translation=JointVariation(baseline_sd=1e-4, rotation_sd=1e-4))
    settings = JointConstraintSettings(laxity={("thigh", "shank"): stiff}, other_joints=stiff, centre_fraction=1.0)
    assert laxity("left_femur", "left_tibia", settings) == laxity("lid", "box", settings) == stiff
    clusters, joint = leg(rng)
    parent, _ = initial_centres(replace(joint, settings=settings), clusters)
    np.testing.assert_allclose(parent, clusters[0].centre, atol=1e-12)
    assert np.abs(initial_centres(joint, clusters)[0] - clusters[0].centre).max() > 0.01


def test_of_an_unknown_joint_only_the_centre_is_held_and_loosely():
    unknown = laxity("lid", "box")
    assert unknown.adduction is None
    assert unknown.rotation is None
    assert unknown.translation.baseline_sd > laxity("thigh", "shank").translation.baseline_sd


def test_instants_far_apart_differ_by_the_given_standard_deviations():
    variation = JointVariation(baseline_sd=0.02, rotation_sd=0.03)
    assert 2 * variation.semivariance(np.array(np.radians(45)), np.array(9.0)) == pytest.approx(0.02**2 + 0.03**2)
    assert variation.semivariance(np.zeros(1), np.zeros(1)) == 0


def test_a_coupled_rotation_grows_in_proportion_to_the_main_one():
    walk, coupled = (JointVariation(baseline_sd=0.0, rotation_sd=0.03, growth=growth) for growth in (1.0, 2.0))
    turn, time = np.radians([22.5, 45.0, 90.0]), np.full(3, 9.0)
    np.testing.assert_allclose(2 * walk.semivariance(turn, time), 0.03**2 * np.array([0.5, 1, 2]))
    np.testing.assert_allclose(2 * coupled.semivariance(turn, time), 0.03**2 * np.array([0.25, 1, 4]))


def test_a_coupled_rotation_is_interpolated_linearly_between_two_known_postures():
    coupled = JointVariation(baseline_sd=0.0, rotation_sd=0.03, growth=2.0)
    turn, known = np.array([0.0, 0.2, 0.5, 1.0, 1.5]), np.array([0.0, 1.0])

    def half(first, second):
        return coupled.semivariance(first[:, None] - second, np.zeros((len(first), len(second))))

    weights, _ = krige(half(turn, known), half(known, known))
    np.testing.assert_allclose(weights[:, 1], turn, atol=1e-6)
