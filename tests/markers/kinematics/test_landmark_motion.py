"""Landmarks that bones carry through a trial."""

import numpy as np
import pytest
from tests.trials import true_bones

from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.landmark_motion import HeldLandmarks, held_landmarks, landmark_motion
from marey.markers.preprocessing.landmarks import anatomical_frames

PLACES = {"ME": [0.0, -0.42, -0.05], "LE": [0.0, -0.42, 0.05], "HJC": [0.0, 0.0, 0.0]}


@pytest.fixture
def motion() -> BoneMotion:
    rotation, origin = true_bones()["thigh"]
    return BoneMotion(
        segments=("right_thigh",), rotation=rotation[:, None], origin=origin[:, None],
        covariance=np.zeros((len(origin), 1, 6, 6)),
    )  # fmt: skip


def carried(motion: BoneMotion, frame: int = 30) -> HeldLandmarks:
    """Landmarks in the laboratory in one frame, held by the thigh that they define there."""
    rotation, origin = motion.rotation[frame, 0], motion.origin[frame, 0]
    at = {f"right_{name}": origin + rotation @ np.array(place) for name, place in PLACES.items()}
    frames = anatomical_frames(at, ["right_thigh", "right_shank"], landmark_sd_m=0.005).frames
    return held_landmarks({**at, "right_LM": np.zeros(3), "note": np.zeros(3)}, frames)


def test_a_known_rigid_motion_gives_the_landmarks_back(motion):
    held = carried(motion)
    assert held.names == ("right_HJC", "right_ME", "right_LE")
    found = landmark_motion(motion, held)
    for k, name in enumerate(("HJC", "ME", "LE")):
        true = motion.origin[:, 0] + motion.rotation[:, 0] @ np.array(PLACES[name])
        np.testing.assert_allclose(found.points[:, k], true, atol=1e-12)
    np.testing.assert_array_equal(found.sd, 0)


def test_the_deviation_is_that_of_simulated_poses(motion):
    """20 000 simulated poses determine a standard deviation to 0.5 %; 3 % are six of these."""
    rng, frame = np.random.default_rng(4), 17
    root = np.diag([0.02, 0.01, 0.03, 2e-3, 1e-3, 3e-3])
    root[0, 3] = 1e-3
    covariance = root @ root.T
    uncertain = BoneMotion(
        segments=motion.segments, rotation=motion.rotation, origin=motion.origin,
        covariance=np.broadcast_to(covariance, (len(motion), 1, 6, 6)),
    )  # fmt: skip
    found = landmark_motion(uncertain, carried(motion))
    errors = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    turned = motion.rotation[frame, 0] @ rotations.exp(errors[:, :3])
    simulated = turned @ np.array(PLACES["LE"]) + errors[:, 3:]
    np.testing.assert_allclose(found.sd[frame, 2], simulated.std(0), rtol=0.03)


def test_landmarks_of_bones_without_a_motion_are_left_out(motion):
    held = HeldLandmarks(names=("left_LE",), segments=("left_thigh",), places=np.zeros((1, 3)))
    assert landmark_motion(motion, held).names == ()
    assert landmark_motion(motion, HeldLandmarks()).points.shape == (len(motion), 0, 3)


def test_a_frame_without_a_pose_has_no_landmark(motion):
    origin = np.array(motion.origin)
    origin[5] = np.nan
    gap = BoneMotion(segments=motion.segments, rotation=motion.rotation, origin=origin, covariance=motion.covariance)
    found = landmark_motion(gap, carried(motion))
    assert np.isnan(found.points[5]).all()
    assert np.isfinite(found.points[6]).all()
