"""The start without clicks: pose, shape and facing from the silhouettes of one frame."""

import numpy as np
import pytest
from tests import worlds

from marey.body.pose import PosedBody
from marey.fit.search import Candidate, StartSettings
from marey.fit.start import _best, find_start

QUICK = StartSettings(yaws=8, kept=2, finalists=1, arm_directions=24, leg_directions=16)
POSTURES = {
    "bent": {"left_elbow_flexion": 80, "right_shoulder_lift": 30, "right_hip_flexion": 30, "right_knee_flexion": 40},
    "raised": {"left_shoulder_lift": 60, "right_shoulder_lift": 45, "left_knee_flexion": 10, "lumbar_flexion": 10},
}  # fmt: skip


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


def test_nobody_and_views_of_different_people_are_no_start():
    cameras, body = worlds.ring(2, distance=6.0), worlds.person()
    nobody = [np.zeros((c.height, c.width), bool) for c in cameras]
    one, other = (worlds.silhouettes(PosedBody(body, worlds.pose(body, at=(0, 0, z))), cameras) for z in (-1.2, 1.2))
    assert find_start(cameras, [one[0], other[1]], body, body, QUICK) is None
    assert find_start(cameras, nobody, body, body, QUICK) is None


def test_of_candidates_that_face_alike_only_some_are_kept():
    body = worlds.person()
    turned = [PosedBody(body, worlds.pose(body, yaw=yaw)) for yaw in (0.0, 0.1, 0.2, 2.0)]
    candidates = [Candidate(posed, score) for posed, score in zip(turned, (0.9, 0.8, 0.7, 0.1), strict=True)]
    assert [c.score for c in _best(candidates, 4, apart=2)] == [0.9, 0.8, 0.1]
    assert [c.score for c in _best(candidates, 1, apart=2)] == [0.9]
