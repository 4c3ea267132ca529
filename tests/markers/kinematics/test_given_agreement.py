"""Agreement with the angles that another program wrote into the file."""

import numpy as np
import pytest

from marey.markers.data.given_angles import GivenAngles
from marey.markers.kinematics.given_agreement import PLUG_IN_GAIT_ANGLES, compare_given_angles
from marey.markers.kinematics.joint_angles import JointKinematics, joint_of

EVERY = np.ones(50, bool)


def ours(*names: str) -> JointKinematics:
    values = 0.1 * np.random.default_rng(2).normal(size=(50, len(names)))
    return JointKinematics(angle_names=names, angles=values, angles_sd=np.full_like(values, 0.01))


def given(labels: tuple[str, ...], values: np.ndarray) -> GivenAngles:
    return GivenAngles(labels=labels, values=values)


def test_every_angle_of_plug_in_gait_is_one_of_ours():
    pairs = {"HipAngles": ("pelvis", "left_thigh"), "KneeAngles": ("left_thigh", "left_shank"),
             "AnkleAngles": ("left_shank", "left_foot")}  # fmt: skip
    for label, names in PLUG_IN_GAIT_ANGLES.items():
        assert tuple(name for name, _ in joint_of(*pairs[label]).angles) == tuple(f"left_{name}" for name in names)


def test_bias_and_spread_are_those_of_the_difference():
    joints = ours("left_knee_flexion", "left_knee_adduction", "left_knee_rotation", "left_elbow_flexion")
    noise = np.random.default_rng(3).normal(size=(50, 3))
    noise = 0.02 * (noise - noise.mean(0)) / noise.std(0, ddof=1)
    rows = compare_given_angles(joints, given(("LKneeAngles",), (joints.angles[:, :3] - 0.05 - noise)[:, None]), EVERY)
    assert [(row.agreement.name, row.component) for row in rows] == [
        ("left_knee_flexion", "x"), ("left_knee_adduction", "y"), ("left_knee_rotation", "z")
    ]  # fmt: skip
    for row in rows:
        assert (row.label, row.agreement.frames) == ("LKneeAngles", 50)
        assert row.agreement.bias == pytest.approx(0.05)
        assert row.agreement.sd == pytest.approx(0.02)


def test_only_the_requested_frames_count():
    joints = ours("right_hip_flexion")
    values = np.repeat(joints.angles[:, :, None], 3, 2)
    values[30:] += 1.0
    (row,) = compare_given_angles(joints, given(("RHipAngles",), values), np.arange(50) < 30)
    assert (row.agreement.frames, row.agreement.bias) == (30, pytest.approx(0))


def test_the_pelvis_has_the_signs_of_each_side():
    joints = ours("pelvis_tilt", "pelvis_obliquity", "pelvis_rotation")
    left, right = joints.angles * [1, 1, -1], joints.angles * [1, -1, 1]
    rows = compare_given_angles(joints, given(("LPelvisAngles", "RPelvisAngles"), np.stack([left, right], 1)), EVERY)
    assert [(row.label[0], row.component, row.sign) for row in rows] == [
        ("L", "x", 1), ("R", "x", 1), ("L", "y", 1), ("R", "y", -1), ("L", "z", -1), ("R", "z", 1)
    ]  # fmt: skip
    assert [row.agreement.rms for row in rows] == [pytest.approx(0)] * 6


@pytest.mark.parametrize(
    "labels", [("LFootProgressAngles",), ("LAbsAnkleAngle",), ("Ann:LKneeAngles", "Bo:LKneeAngles"), ("KneeAngles",)]
)
def test_angles_without_one_counterpart_are_not_compared(labels):
    joints = ours("left_knee_flexion")
    assert compare_given_angles(joints, given(labels, np.ones((50, len(labels), 3))), EVERY) == ()


def test_the_name_of_one_person_before_a_label_is_ignored():
    rows = compare_given_angles(ours("left_knee_flexion"), given(("Ann:LKneeAngles",), np.ones((50, 1, 3))), EVERY)
    assert [row.label for row in rows] == ["Ann:LKneeAngles"]


def test_an_angle_without_values_is_not_compared():
    empty = given(("LKneeAngles",), np.full((50, 1, 3), np.nan))
    assert compare_given_angles(ours("left_knee_flexion"), empty, EVERY) == ()
