"""The start from clicked joints."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.errors import MareyError
from marey.fit.recipes.person import PersonSettings, SilhouetteTake
from marey.fit.recipes.start_joints import start_from_joints

YAW = 2.6


@pytest.fixture(scope="module")
def scene():
    body = worlds.person("coarse")
    truth = PosedBody(body, worlds.pose(body, yaw=YAW, at=(0.1, -0.05, 0.02)))
    cameras = worlds.ring()
    return truth, worlds.take([truth], cameras)


def clicks(truth, cameras, joints, rng, *, sigma=2.0):
    body = truth.body
    centres = truth.segment_origin[body.joint_segments][[list(body.joint_names).index(name) for name in joints]]
    return (
        np.array([camera.project(centres) for camera in cameras])
        + rng.normal(size=(len(cameras), len(joints), 2)) * sigma
    )


@pytest.mark.slow
def test_pose_and_facing_are_estimated_from_joints_and_silhouettes(scene, rng):
    truth, take = scene
    names = truth.body.joint_names
    pixels = clicks(truth, take.cameras, names, rng)
    frame, found = start_from_joints(take, 0, names, pixels, truth.body, PersonSettings())
    assert frame == 0
    assert found.posed.pose.rotation[:, 1] @ truth.pose.rotation[:, 1] > np.cos(np.deg2rad(10))
    assert worlds.joint_errors(found.posed, truth).max() < 0.05
    assert found.score > 0.85


def test_a_few_joints_in_some_cameras_determine_the_facing(scene, rng):
    truth, take = scene
    names = ("left_hip", "right_hip", "left_shoulder", "right_shoulder", "left_wrist", "right_ankle")
    pixels = clicks(truth, take.cameras, names, rng)
    pixels[2:] = np.nan
    pixels[0, 4] = np.nan
    _, found = start_from_joints(take, 0, names, pixels, truth.body, PersonSettings())
    assert found.posed.pose.rotation[:, 1] @ truth.pose.rotation[:, 1] > np.cos(np.deg2rad(25))
    assert np.median(worlds.joint_errors(found.posed, truth)) < 0.06


def test_joints_alone_give_a_start_without_silhouettes(scene, rng):
    truth, take = scene
    empty = [np.zeros_like(mask) for mask in take.masks_of(0)]
    ignored_frames = SilhouetteTake(take.cameras, lambda frame: empty, (0,), take.rate)
    names = truth.body.joint_names
    pixels = clicks(truth, take.cameras, names, rng, sigma=0.5)
    _, found = start_from_joints(ignored_frames, 0, names, pixels, truth.body, PersonSettings())
    # A click counts three hundredths of the person's height: about five centimetres each; the prior adds less.
    assert worlds.joint_errors(found.posed, truth).mean() < 0.05


def test_too_few_joints_in_two_cameras_are_rejected(scene, rng):
    truth, take = scene
    names = ("left_hip", "right_hip", "left_shoulder")
    pixels = clicks(truth, take.cameras, names, rng)
    pixels[1:, 0] = np.nan
    with pytest.raises(MareyError, match="at least three joints that are given in two cameras"):
        start_from_joints(take, 0, names, pixels, truth.body, PersonSettings())


@pytest.mark.slow
@pytest.mark.parametrize("body", [worlds.scan(), person_body("coarse", preset="upper")], ids=["scan", "upper"])
def test_a_scan_and_a_preset_start_from_joints_too(scene, rng, body):
    truth, take = scene
    names = truth.body.joint_names
    pixels = clicks(truth, take.cameras, names, rng)
    _, found = start_from_joints(take, 0, names, pixels, body, PersonSettings())
    assert found.posed.pose.rotation[:, 1] @ truth.pose.rotation[:, 1] > np.cos(np.deg2rad(25))
