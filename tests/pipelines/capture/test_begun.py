"""The start of a capture in silhouettes: what it rejects."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.fit.recipes.person import PersonSettings, SilhouetteTake
from marey.fit.search.search import Candidate
from marey.pipelines.capture import begun
from marey.pipelines.capture.run import Bodies
from marey.pipelines.verdict import NotUsable

POSTURE = {"right_shoulder_lift": -20, "right_elbow_flexion": 60, "left_hip_flexion": 25, "left_knee_flexion": 35}


def run(preset):
    settings = SimpleNamespace(preset=preset, stature_m=None)
    trial = SimpleNamespace(settings=settings, calibration="reach/cameras.toml", up_given=False, start=None)
    return SimpleNamespace(trial=trial, person=PersonSettings())


def start_with(preset, shown):
    """Search the start of a preset in the silhouettes of a posed body."""
    cameras = worlds.ring(3)
    masks = worlds.silhouettes(shown, cameras)
    take = SilhouetteTake(cameras, lambda frame: masks, (0,), worlds.RATE)
    bodies = Bodies(*(person_body("coarse", preset=preset) for _ in range(2)))
    return begun.begin(run(preset), take, bodies, None, None, done=lambda frame: None)


@pytest.mark.slow
def test_a_limb_is_not_searched_in_silhouettes_of_a_whole_person():
    body = person_body("coarse", preset="full")
    with pytest.raises(NotUsable, match="silhouettes show more of the person") as caught:
        start_with("right_arm", PosedBody(body, worlds.pose(body, POSTURE)))
    [reason] = caught.value.verdict.reasons
    assert reason.cause == "preset"
    assert "Leave out the preset" in reason.remedy
    # The calibration is right: the message must not suggest to change the vertical axis.
    assert "[world]" not in str(caught.value)


@pytest.mark.slow
def test_a_limb_alone_is_found():
    body = person_body("coarse", preset="right_arm")
    truth = PosedBody(body, worlds.pose(body, {name: x for name, x in POSTURE.items() if "right" in name}))
    _, found = start_with("right_arm", truth)
    assert found.score > begun.LIMB_AGREEMENT
    followed = body.joint_segments[body.followed_joints]
    assert np.linalg.norm((found.posed.segment_origin - truth.segment_origin)[followed], axis=1).max() < 0.1


@pytest.mark.parametrize(("preset", "score"), [("full", 0.4), ("upper", 0.4), (None, 0.4), ("left_leg", 0.8)])
def test_only_presets_of_a_single_limb_need_silhouettes_of_it_alone(preset, score):
    posed = PosedBody(worlds.person(), worlds.pose(worlds.person()))
    begun.require_limb_alone(run(preset).trial, Candidate(posed, score))
    with pytest.raises(NotUsable, match="left_leg"):
        begun.require_limb_alone(run("left_leg").trial, Candidate(posed, begun.LIMB_AGREEMENT - 0.01))
