"""Constant errors of bones and angles due to assumed measurements."""

import numpy as np
import pytest
from tests.trials import true_bones

from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration
from marey.markers.data.person import AssumedMeasurement
from marey.markers.kinematics.calibration_offsets import (
    joints_with_offsets,
    motion_with_offsets,
    offsets_between,
)
from marey.markers.kinematics.joint_angles import joint_kinematics, joint_of
from marey.markers.preprocessing.own_frames import BonesAndMarkers

SIZES = [AssumedMeasurement(name=name, value_m=0.1, sd_m=0.01, source="made") for name in ("left_knee_width", "other")]
KNEE = [joint_of("thigh", "shank")]


def bones(rotation: np.ndarray, origin: np.ndarray) -> BonesAndMarkers:
    return BonesAndMarkers(
        segments=("thigh", "shank"), rotation=rotation, origin=origin, labels=(), points=np.zeros((0, 3))
    )


@pytest.fixture
def motion() -> BoneMotion:
    (thigh, hip), (shank, knee) = true_bones().values()
    covariance = np.broadcast_to(1e-6 * np.eye(6), (len(hip), 2, 6, 6))
    return BoneMotion(
        segments=("thigh", "shank"), rotation=np.stack([thigh, shank], 1), origin=np.stack([hip, knee], 1),
        covariance=covariance,
    )  # fmt: skip


def offsets_of(motion: BoneMotion, turns: list[list[np.ndarray]], shift: np.ndarray):
    """Offsets of two measurements, found in the third frame; the shift [m] is that of all bones by the first one."""
    posture = bones(motion.rotation[3], motion.origin[3])
    larger = [
        bones(
            posture.rotation @ rotations.exp(np.array(turn)),
            posture.origin + (posture.rotation @ shift if not q else 0),
        )
        for q, turn in enumerate(turns)
    ]
    return offsets_between(SIZES, posture, larger)


def calibration(motion: BoneMotion) -> AnatomicalCalibration:
    return AnatomicalCalibration(
        segments=motion.segments, frames=[3], rotation=motion.rotation[3:4], origin=motion.origin[3:4]
    )


def angles(motion: BoneMotion, reference: AnatomicalCalibration):
    return joint_kinematics(motion, KNEE)


def test_offsets_are_those_of_the_posture_in_the_frames_of_the_bones(motion):
    x = np.eye(3)[0]
    found = offsets_of(motion, [[0.01 * x, -0.02 * x], [0 * x, 0 * x]], np.array([0, 0, 0.005]))
    np.testing.assert_allclose(found.rotation, [[0.01 * x, -0.02 * x], [0 * x, 0 * x]], atol=1e-12)
    np.testing.assert_allclose(found.origin[0], [[0, 0, 0.005]] * 2, atol=1e-12)


def test_a_rotation_of_both_bones_at_once_changes_no_angle(motion):
    """About the axis of flexion; the sum of both bones' variances would be 1.1 degrees."""
    axis = 0.02 * np.eye(3)[2]
    straight = np.array(motion.rotation)
    straight[:, 1] = straight[:, 0]
    together = BoneMotion(
        segments=motion.segments, rotation=straight, origin=motion.origin, covariance=motion.covariance
    )
    offsets = offsets_of(together, [[axis, axis], [0 * axis, 0 * axis]], np.zeros(3))
    joints, rows = joints_with_offsets(together, calibration(together), offsets, angles)
    np.testing.assert_allclose(joints.angles_sd, angles(together, calibration(together)).angles_sd, rtol=1e-6)
    assert rows == ()


def test_variances_of_measurements_add_up(motion):
    """A rotation of the shank about its own axis is a change of rotation, whatever the flexion."""
    y = np.eye(3)[1]
    offsets = offsets_of(motion, [[0 * y, 0.03 * y], [0 * y, 0.04 * y]], np.zeros(3))
    joints, rows = joints_with_offsets(motion, calibration(motion), offsets, angles)
    plain = angles(motion, calibration(motion))
    k = joints.angle_names.index("knee_rotation")
    np.testing.assert_allclose(joints.angles_sd[:, k] ** 2 - plain.angles_sd[:, k] ** 2, 0.05**2, rtol=1e-6)
    np.testing.assert_array_equal(joints.angles, plain.angles)
    sds = {(row.measurement.name, row.angle): row.sd for row in rows}
    assert sds["left_knee_width", "knee_rotation"] == pytest.approx(0.03)
    assert sds["other", "knee_rotation"] == pytest.approx(0.04)


def test_bones_have_the_constant_error_in_their_covariance(motion):
    turn, shift = np.array([0.01, 0, 0]), np.array([0, 0, 0.005])
    offsets = offsets_of(motion, [[turn, 0 * turn], [0 * turn, 0 * turn]], shift)
    added = motion_with_offsets(motion, offsets).covariance - motion.covariance
    np.testing.assert_allclose(
        added[:, 0, :3, :3], np.broadcast_to(np.outer(turn, turn), (len(motion), 3, 3)), atol=1e-12
    )
    for f in (0, 50):
        in_laboratory = motion.rotation[f, 1] @ shift
        np.testing.assert_allclose(added[f, 1, 3:, 3:], np.outer(in_laboratory, in_laboratory), atol=1e-12)


def test_frames_without_a_pose_stay_empty(motion):
    rotation = np.array(motion.rotation)
    rotation[7] = np.nan
    gap = BoneMotion(segments=motion.segments, rotation=rotation, origin=motion.origin, covariance=motion.covariance)
    x = np.eye(3)[0]
    offsets = offsets_of(motion, [[0.01 * x, 0 * x], [0 * x, 0 * x]], np.zeros(3))
    joints, rows = joints_with_offsets(gap, calibration(motion), offsets, angles)
    assert np.isnan(joints.angles_sd[7]).all()
    assert np.isfinite(joints.angles_sd[8]).all()
    assert all(np.isfinite(row.sd) for row in rows)
