"""Angles and translations of joints: those of Grood and Suntay, mirrored sides, deviations that are true ones."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration
from marey.markers.kinematics.joint_angles import joint_kinematics, joint_of, joint_point, turns_since, usual_joints

X, Y, Z = np.eye(3)


def bones(relative, reach, *, names=("thigh", "shank"), covariance=None):
    """Two bones somewhere in the laboratory, the child turned and moved in the parent."""
    frames = len(relative)
    parent = rotations.exp(np.array([0.4, -1.1, 0.7])) @ np.broadcast_to(np.eye(3), (frames, 3, 3))
    origin = np.array([1.0, 2.0, 0.5]) + np.zeros((frames, 3))
    child = origin + np.einsum("fij,fj->fi", parent, np.broadcast_to(reach, (frames, 3)))
    cov = np.zeros((frames, 2, 6, 6)) if covariance is None else np.broadcast_to(covariance, (frames, 2, 6, 6))
    return BoneMotion(
        segments=names, rotation=np.stack([parent, parent @ relative], 1), origin=np.stack([origin, child], 1),
        covariance=cov,
    )  # fmt: skip


def turned(flexion, adduction, rotation):
    return (rotations.about(Z, flexion) @ rotations.about(X, adduction) @ rotations.about(Y, rotation))[None]


def test_a_right_knee_gives_flexion_varus_and_inward_rotation():
    found = joint_kinematics(bones(turned(-0.9, 0.1, 0.2), [0.0, -0.4, 0.0]), [joint_of("thigh", "shank")])
    assert found.angle_names == ("knee_flexion", "knee_adduction", "knee_rotation")
    np.testing.assert_allclose(found.angles[0], [0.9, 0.1, 0.2], atol=1e-12)


def test_a_left_knee_that_is_the_mirror_image_has_the_same_angles_and_translations():
    relative, reach = turned(-0.9, 0.1, 0.2), np.array([0.01, -0.4, 0.005])
    mirror = np.diag([1.0, 1.0, -1.0])
    right = joint_kinematics(bones(relative, reach), [joint_of("thigh", "shank", "right")])
    left = joint_kinematics(bones(mirror @ relative @ mirror, mirror @ reach), [joint_of("thigh", "shank", "left")])
    np.testing.assert_allclose(left.angles, right.angles, atol=1e-12)
    np.testing.assert_allclose(left.translations, right.translations, atol=1e-12)


def test_translations_lie_along_the_parents_z_the_floating_axis_and_the_childs_y():
    straight = joint_kinematics(bones(np.eye(3)[None], [0.01, -0.03, 0.002]), [joint_of("thigh", "shank")])
    assert straight.translation_names == ("knee_lateral", "knee_anterior", "knee_distraction")
    np.testing.assert_allclose(straight.translations[0], [0.002, 0.01, 0.03], atol=1e-12)
    # Bent by a right angle, what the thigh calls forward is along the shank.
    bent = joint_kinematics(bones(turned(-np.pi / 2, 0.0, 0.0), [0.01, -0.03, 0.002]), [joint_of("thigh", "shank")])
    np.testing.assert_allclose(bent.translations[0], [0.002, 0.03, -0.01], atol=1e-12)


def test_a_joint_moves_where_its_bones_meet_and_not_at_their_far_ends():
    """A hinge 0.4 m below the hip, with the shank's origin at the ankle, whose knee slides forward by 5 mm at times."""
    time = np.arange(200) / 50
    relative, slide = rotations.about(Z, -0.8 + 0.7 * np.cos(3 * time)), 0.005 * np.sin(11 * time)
    knee, ankle = np.array([0.02, -0.4, 0.01]), np.array([0.0, -0.38, 0.0])
    floating = np.stack([relative[:, 1, 1], -relative[:, 0, 1], 0 * time], -1)
    moved = bones(relative, knee + relative @ ankle + slide[:, None] * floating)
    reference = AnatomicalCalibration(
        segments=("thigh", "shank"), frames=[0], rotation=moved.rotation[:1], origin=moved.origin[:1]
    )  # fmt: skip
    joint = joint_of("thigh", "shank")
    point = joint_point(moved, joint, reference)
    # The place along the axis of the hinge is free; sliding by 5 mm moves the centre by less than that.
    np.testing.assert_allclose(point.parent[:2], knee[:2], atol=0.003)
    found = joint_kinematics(moved, [joint], {"knee": point}).translations
    np.testing.assert_allclose(found[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found[:, 1], slide, atol=0.003)
    np.testing.assert_allclose(found[:, [0, 2]], 0.0, atol=0.003)


def test_stated_deviations_are_those_of_draws(rng):
    root = 0.01 * rng.normal(size=(6, 6))
    covariance = root @ root.T
    true = bones(turned(-0.9, 0.2, 0.3), [0.01, -0.05, 0.02], covariance=covariance)
    joint = [joint_of("thigh", "shank")]
    stated = joint_kinematics(true, joint)
    count = 4000
    drawn = rng.multivariate_normal(np.zeros(6), covariance, size=(count, 2))
    many = BoneMotion(
        segments=true.segments, rotation=true.rotation @ rotations.exp(drawn[..., :3]),
        origin=true.origin + drawn[..., 3:], covariance=np.zeros((count, 2, 6, 6)),
    )  # fmt: skip
    found = joint_kinematics(many, joint)
    # A standard deviation of 4000 draws is good to 1 / sqrt(2 n), 1.1 %; second-order terms are of the size sd.
    np.testing.assert_allclose(found.angles.std(0), stated.angles_sd[0], rtol=0.06)
    np.testing.assert_allclose(found.translations.std(0), stated.translations_sd[0], rtol=0.06)


def test_an_angle_runs_on_through_half_a_turn_and_over_a_gap():
    flexion = -np.linspace(1.6, 3.6, 21)
    relative = rotations.about(Z, flexion)
    relative[8:11] = np.nan
    found = joint_kinematics(bones(relative, [0.0, -0.4, 0.0]), [joint_of("thigh", "shank")])
    kept = np.isfinite(found.angles[:, 0])
    assert not kept[8:11].any()
    np.testing.assert_allclose(found.angles[kept, 0], -flexion[kept], atol=1e-12)


def test_unknown_covariance_leaves_deviations_unknown_and_angles_known():
    found = joint_kinematics(
        bones(turned(-0.9, 0.1, 0.2), [0.0, -0.4, 0.0], covariance=np.full((6, 6), np.nan)),
        [joint_of("thigh", "shank")],
    )
    assert np.isfinite(found.angles).all()
    assert np.isnan(found.angles_sd).all()


@pytest.mark.parametrize(
    ("parent", "child", "first", "left"),
    [
        ("left_thigh", "left_shank", "left_knee_flexion", True),
        ("pelvis", "right_thigh", "right_hip_flexion", False),
        ("left_upperarm", "left_forearm", "left_elbow_flexion", True),
        ("shank", "foot", "ankle_dorsiflexion", False),
        ("LF", "LT", "LT_on_LF_flexion", False),
    ],
)
def test_joints_are_named_by_their_bones(parent, child, first, left):
    joint = joint_of(parent, child)
    assert joint.angles[0][0] == first
    assert joint.left == left


def test_the_joints_of_a_person_are_found_by_name():
    segments = ("pelvis", "left_thigh", "left_shank", "right_thigh", "plate")
    wanted = (("pelvis", "left_thigh"), ("left_thigh", "left_shank"), ("pelvis", "right_thigh"))
    assert usual_joints(segments) == wanted


def test_the_total_rotation_since_a_frame_needs_no_axes():
    relative = rotations.about(Y, np.array([0.3, 0.5, 0.1]))
    found = turns_since(bones(relative, [0.0, -0.4, 0.0]), [("thigh", "shank")], 0)
    assert found.angle_names == ("knee_total_rotation",)
    np.testing.assert_allclose(found.angles[:, 0], [0, 0.2, 0.2], atol=1e-12)
