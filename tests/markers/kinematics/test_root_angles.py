"""Angles of the pelvis in the laboratory."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.root_angles import with_root_angles
from marey.motion.anatomical import WORLD_FRAME

NONE = JointKinematics(
    angle_names=("left_knee_flexion",), angles=np.ones((40, 1)), angles_sd=np.full((40, 1), 0.1),
    translation_names=("left_knee_lateral",), translations=np.zeros((40, 1)), translations_sd=np.zeros((40, 1)),
)  # fmt: skip


def pelvis(reference: np.ndarray, covariance: np.ndarray | None = None) -> tuple[BoneMotion, np.ndarray]:
    """A pelvis that turns about the vertical, then down on the right, then forward; and these angles (F, 3) [rad]."""
    time = np.arange(40) / 40
    turn, down, forward = 0.5 * time, 0.2 * np.sin(6 * time), 0.3 * np.cos(5 * time)
    axes = np.eye(3)
    local = rotations.about(axes[1], turn) @ rotations.about(axes[0], down) @ rotations.about(axes[2], -forward)
    spread = np.zeros((40, 1, 6, 6)) if covariance is None else np.broadcast_to(covariance, (40, 1, 6, 6))
    motion = BoneMotion(
        segments=("pelvis",), rotation=(reference @ local)[:, None], origin=np.zeros((40, 1, 3)), covariance=spread
    )
    return motion, np.stack([forward, down, turn], 1)


@pytest.mark.parametrize(("reference", "y_up"), [(WORLD_FRAME, False), (np.eye(3), True)])
def test_the_angles_are_those_of_the_turns(reference, y_up):
    motion, true = pelvis(reference)
    found = with_root_angles(NONE, motion, y_up=y_up)
    assert found.angle_names == ("pelvis_tilt", "pelvis_obliquity", "pelvis_rotation", "left_knee_flexion")
    np.testing.assert_allclose(found.angles[:, :3], true, atol=1e-12)
    np.testing.assert_array_equal(found.angles[:, 3], 1.0)
    assert found.translation_names == NONE.translation_names


@pytest.mark.slow
def test_standard_deviations_are_those_of_drawn_errors():
    rng = np.random.default_rng(4)
    root = 0.01 * rng.normal(size=(3, 3))
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = root @ root.T
    motion, _ = pelvis(np.eye(3), covariance)
    stated = with_root_angles(NONE, motion, y_up=True).angles_sd[:, :3]
    drawn = []
    for _ in range(400):
        error = rotations.exp((root @ rng.normal(size=3))[None, None])
        moved = BoneMotion(
            segments=("pelvis",), rotation=motion.rotation @ error, origin=motion.origin, covariance=motion.covariance
        )
        drawn.append(with_root_angles(NONE, moved, y_up=True).angles[:, :3])
    # The standard deviation of 400 draws is known to 1 / sqrt(800) = 3.5 %; the same draws serve every frame.
    np.testing.assert_allclose(np.std(drawn, 0) / stated, 1.0, atol=4 * 0.035)


def test_without_pelvis_or_thorax_nothing_is_added():
    motion, _ = pelvis(np.eye(3))
    other = BoneMotion(
        segments=("left_thigh",), rotation=motion.rotation, origin=motion.origin, covariance=motion.covariance
    )
    assert with_root_angles(NONE, other, y_up=True) is NONE


def test_gaps_stay_gaps():
    motion, _ = pelvis(np.eye(3))
    rotation = np.array(motion.rotation)
    rotation[5] = np.nan
    gap = BoneMotion(
        segments=motion.segments, rotation=rotation, origin=motion.origin, covariance=motion.covariance
    )
    found = with_root_angles(NONE, gap, y_up=True)
    assert np.isnan(found.angles[5, :3]).all()
    assert np.isfinite(found.angles[[4, 6], :3]).all()
