"""The world of cameras in any axes and unit, from a made person who walks or stands before them."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_boards import made_rig

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.fit.cameras.from_joints import ANKLE_HEIGHT_M, BoneLengths
from marey.fit.cameras.joint_pairs import BONES, JointSightings
from marey.fit.cameras.person_world import PersonWorld, find_person_world
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

UPRIGHT = {
    "hip": (0.1, 0.0, 0.88), "knee": (0.1, 0.0, 0.48), "ankle": (0.1, 0.0, ANKLE_HEIGHT_M),
    "shoulder": (0.2, 0.0, 1.4), "elbow": (0.25, 0.0, 1.1), "wrist": (0.25, 0.1, 0.85),
}  # fmt: skip
"""Joints of a person's right side who looks along y [m]."""
NAMES = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in UPRIGHT)
UNIT, AXES = 37.0, RigidTransform(rotations.exp(np.array([0.8, -1.4, 0.5])), np.array([1.0, -2.0, 0.7]))
"""The unit and axes of the given calibration: per metre, and from the world."""


def person(step: float, turn: float, frames: int = 40) -> Floats:
    """Joints (F, J, 3) of a person who looks along a direction and moves along it by steps [m]."""
    right = np.array(list(UPRIGHT.values()))
    both = np.concatenate([right * [-1, 1, 1], right])
    along = np.arange(frames)[:, None, None] - 0.5 * (frames - 1)
    return np.asarray((both + along * np.array([0.0, step, 0.0])) @ rotations.about(np.array([0, 0, 1.0]), turn).T)


def sightings(cameras: tuple[Camera, ...], joints: Floats, noise: float = 0.5) -> JointSightings:
    pixels = np.stack([camera.project(joints.reshape(-1, 3)).reshape(*joints.shape[:2], 2) for camera in cameras], 1)
    pixels = pixels + np.random.default_rng(2).normal(0, noise, pixels.shape)
    return JointSightings(joint_names=NAMES, pixels=pixels, confidence=np.ones(pixels.shape[:3]))


def lengths(factor: float = 1.0) -> BoneLengths:
    place = dict(zip(NAMES, person(0.0, 0.0, 1)[0], strict=True))
    expected = np.array([np.linalg.norm(place[a] - place[b]) for a, b in BONES])
    return BoneLengths(expected_m=factor * expected, covariance=0.03**2 * np.eye(len(BONES)) + 0.04**2)


def found_world(joints: Floats, factor: float = 1.0) -> tuple[PersonWorld, tuple[Camera, ...]]:
    true = tuple(made_rig(4, np.random.default_rng(3)))
    moved = [camera.moved(AXES).camera_from_world for camera in true]
    given = tuple(
        replace(camera, camera_from_world=RigidTransform(pose.rotation, UNIT * pose.translation))
        for camera, pose in zip(true, moved, strict=True)
    )
    found = find_person_world(given, sightings(true, joints), lengths(factor))
    assert found is not None
    return found, true


@pytest.mark.parametrize(("step", "walked"), [(0.08, True), (0.0, False)])
def test_axes_floor_heading_and_scale_are_recovered(step: float, walked: bool):
    turn = 0.7
    found, true = found_world(person(step, turn))
    assert found.walked is walked
    assert not found.backwards
    assert not found.contradicted
    # Noise of 0.5 px at 4 m is 2 mm; the mean over 40 frames and several joints is better.
    assert found.scale * UNIT == pytest.approx(1.0, abs=2e-3)
    ahead = RigidTransform(rotations.about(np.array([0, 0, 1.0]), -turn), np.zeros(3))
    for own, camera in zip(found.cameras, true, strict=True):
        expected = camera.moved(ahead)
        apart = rotations.log(own.camera_from_world.rotation @ expected.camera_from_world.rotation.T)
        assert np.degrees(np.linalg.norm(apart)) < 0.4
        np.testing.assert_allclose(own.centre, expected.centre, atol=0.03)
    # The stated scale, as that of four arms and legs of common deviation 4 % and own 3 %.
    assert found.scale_sd == pytest.approx(np.hypot(0.04, 0.03 / np.sqrt(len(BONES))), rel=1e-6)


def test_the_scale_is_that_of_the_bones():
    found, _ = found_world(person(0.08, 0.0), factor=1.1)
    assert found.scale * UNIT == pytest.approx(1.1, abs=2e-3)
    height = np.mean([camera.centre[2] for camera in found.cameras])
    sd = np.sqrt(np.trace(found.covariance))
    assert sd > found.scale_sd * height


def test_a_person_who_walks_backwards_is_named():
    found, _ = found_world(person(-0.08, 0.3))
    assert found.backwards


def test_joints_of_other_people_contradict_the_cameras():
    true = tuple(made_rig(4, np.random.default_rng(3)))
    joints = person(0.08, 0.0)
    seen = sightings(true, joints)
    pixels = np.array(seen.pixels)
    pixels[:, 1] = sightings(true, joints + [1.0, 0.5, 0.0]).pixels[:, 1]
    found = find_person_world(true, replace(seen, pixels=pixels), lengths())
    assert found is not None
    assert found.contradicted


def test_without_joints_in_two_cameras_there_is_no_world():
    true = tuple(made_rig(4, np.random.default_rng(3)))
    seen = sightings(true, person(0.08, 0.0))
    pixels = np.array(seen.pixels)
    pixels[:, 1:] = np.nan
    assert find_person_world(true, replace(seen, pixels=pixels), lengths()) is None
