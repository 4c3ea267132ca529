"""The start without clicks: pose, shape and facing from the silhouettes of one frame."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.people.person import person_body
from marey.fit.search.search import Candidate, StartSettings
from marey.fit.search.start import _best, find_start
from marey.geometry import rotations

QUICK = StartSettings(yaws=8, kept=2, finalists=1, arm_directions=24, leg_directions=16)
FEW_HEADINGS = replace(QUICK, yaws=6)
"""Where several directions of the trunk are tried in each heading."""
POSTURES = {
    "bent": {"left_elbow_flexion": 80, "right_shoulder_lift": 30, "right_hip_flexion": 30, "right_knee_flexion": 40},
    "raised": {"left_shoulder_lift": 60, "right_shoulder_lift": 45, "left_knee_flexion": 10, "lumbar_flexion": 10},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("posture", "yaw"), [("bent", 0.5), ("raised", 3.4)])
def test_pose_shape_and_facing_are_found_from_one_frame(posture, yaw):
    fine, coarse = worlds.person("fine"), worlds.person("coarse")
    person = fine.with_numbers(np.array([0.8, -0.6, 0.5, 0.3, -0.4, 0.2]))
    truth = PosedBody(person, worlds.pose(person, POSTURES[posture], yaw=yaw, at=(0.05, 0.02, 0.0)))
    cameras = worlds.ring()
    found = find_start(cameras, worlds.silhouettes(truth, cameras), coarse, fine, QUICK)
    facing = found.posed.pose.rotation[:, 1] @ truth.pose.rotation[:, 1]
    assert facing > np.cos(np.deg2rad(20))
    assert worlds.joint_errors(found.posed, truth).max() < 0.15
    assert found.score > 0.85
    assert len(found.posed.body.vertices) == len(fine.vertices)


def test_empty_or_contradictory_silhouettes_give_no_start():
    cameras, body = worlds.ring(2, distance=6.0), worlds.person()
    empty_masks = [np.zeros((c.height, c.width), bool) for c in cameras]
    one, other = (worlds.silhouettes(PosedBody(body, worlds.pose(body, at=(0, 0, z))), cameras) for z in (-1.2, 1.2))
    assert find_start(cameras, [one[0], other[1]], body, body, QUICK) is None
    assert find_start(cameras, empty_masks, body, body, QUICK) is None


def test_only_some_candidates_of_the_same_facing_are_kept():
    body = worlds.person()
    turned = [PosedBody(body, worlds.pose(body, yaw=yaw)) for yaw in (0.0, 0.1, 0.2, 2.0)]
    candidates = [Candidate(posed, score) for posed, score in zip(turned, (0.9, 0.8, 0.7, 0.1), strict=True)]
    assert [c.score for c in _best(candidates, 4, apart=2)] == [0.9, 0.8, 0.1]
    assert [c.score for c in _best(candidates, 1, apart=2)] == [0.9]


@pytest.mark.slow
@pytest.mark.parametrize("kept", [(0, 1, 2), (1, 2, 3)], ids=["without the last", "without the first"])
def test_three_cameras_determine_the_facing(kept):
    body = worlds.person("coarse")
    truth = PosedBody(body, worlds.pose(body, POSTURES["bent"], yaw=1.2))
    cameras = [worlds.ring()[k] for k in kept]
    found = find_start(cameras, worlds.silhouettes(truth, cameras), body, body, QUICK)
    assert found.posed.pose.rotation[:, 1] @ truth.pose.rotation[:, 1] > np.cos(np.deg2rad(20))
    assert np.median(worlds.joint_errors(found.posed, truth)) < 0.04


@pytest.mark.slow
def test_a_person_cut_at_the_hips_is_found_with_the_upper_preset():
    whole, body = worlds.person("coarse"), person_body("coarse", preset="upper")
    posture = {"left_elbow_flexion": 80, "right_shoulder_lift": 30, "right_elbow_flexion": 30}
    truth = PosedBody(whole, worlds.pose(whole, posture, yaw=0.8))
    cameras = worlds.ring(size=(200, 135), target=(0, 0, 0.32))
    masks = worlds.silhouettes(truth, cameras)
    assert all(mask[-1].any() for mask in masks)
    found = find_start(cameras, masks, body, body, StartSettings(yaws=8, kept=3, finalists=1))
    assert found.posed.pose.rotation[:, 1] @ truth.pose.rotation[:, 1] > np.cos(np.deg2rad(20))
    arms = [i for i, name in enumerate(body.joint_names) if name.endswith(("shoulder", "elbow", "wrist"))]
    assert worlds.joint_errors(found.posed, truth)[arms].max() < 0.02


@pytest.mark.slow
def test_a_scan_starts_with_the_shape_that_it_has():
    body = worlds.scan()
    truth = PosedBody(body, worlds.pose(body, POSTURES["raised"], yaw=5.0))
    cameras = worlds.ring()
    found = find_start(cameras, worlds.silhouettes(truth, cameras), body, body, QUICK)
    np.testing.assert_array_equal(found.posed.body.vertices, body.vertices)
    assert worlds.joint_errors(found.posed, truth).max() < 0.1


@pytest.mark.slow
def test_a_lying_person_is_found():
    body = worlds.person("coarse")
    standing = worlds.pose(body, POSTURES["bent"])
    lying = Pose(np.array([0.0, 0, -0.3]), rotations.about(np.array([1.0, 0, 0]), np.array(np.pi / 2)), standing.angles)
    truth = PosedBody(body, lying)
    cameras = worlds.ring(size=(200, 160), focal=160.0)
    found = find_start(cameras, worlds.silhouettes(truth, cameras), body, body, FEW_HEADINGS)
    trunk = found.posed.pose.rotation[:, 2]
    assert abs(trunk[2]) < 0.3


@pytest.mark.slow
def test_a_person_hanging_head_down_is_found():
    body = worlds.person("coarse")
    arms_up = worlds.pose(body, {"left_shoulder_lift": 50, "left_elbow_flexion": 60, "right_hip_abduction": 30})
    truth = PosedBody(body, Pose(np.zeros(3), rotations.about(np.array([1.0, 0, 0]), np.array(np.pi)), arms_up.angles))
    cameras = worlds.ring(target=(0, 0, 0.1))
    found = find_start(cameras, worlds.silhouettes(truth, cameras), body, body, FEW_HEADINGS)
    assert found.posed.pose.rotation[2, 2] < -0.8
