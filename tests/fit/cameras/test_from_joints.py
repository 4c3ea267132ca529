"""Cameras placed by the joints of a made walk, whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.fit.cameras.from_joints import BoneLengths, block_basis, place_cameras, standing_world
from marey.fit.cameras.joint_pairs import BONES, JointSightings, camera_pair
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

FRAMES, NOISE_PX = 60, 1.0
SIDES = ("left", "right")
NAMES = tuple(f"{side}_{joint}" for side in SIDES for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"))
LENGTHS = np.array([0.42, 0.43, 0.29, 0.26] * 2)


def walker(frames: int = FRAMES, *, moving: bool = True) -> np.ndarray:
    """Joints (F, 12, 3) of a person with rigid bones who walks on a curve, swings arms and legs, and turns [m]."""
    points = np.zeros((frames, len(NAMES), 3))
    for f in range(frames):
        phase = 0.25 * f if moving else 0.0
        yaw = 0.6 * np.sin(0.06 * f) if moving else 0.0
        turn = rotations.exp(np.array([0.0, 0.0, yaw]))
        place = np.array([0.3 * np.sin(0.1 * f), -1.2 + 0.04 * f, 0.0]) if moving else np.zeros(3)
        for side, sign, base in (("left", -1.0, 0.0), ("right", 1.0, np.pi)):
            swing, bend = 0.5 * np.sin(phase + base), 0.5 + 0.4 * np.cos(phase + base)
            hip, shoulder = np.array([0.1 * sign, 0.0, 0.92]), np.array([0.19 * sign, 0.0, 1.42])
            knee = hip + 0.42 * leaning(swing)
            ankle = knee + 0.43 * leaning(swing - bend * 0.6)
            elbow = shoulder + 0.29 * leaning(-swing, 0.2 * sign)
            wrist = elbow + 0.26 * leaning(-swing + bend, 0.1 * sign)
            for k, joint in enumerate((shoulder, elbow, wrist, hip, knee, ankle)):
                points[f, 6 * (side == "right") + k] = turn @ joint + place
    return points


def leaning(forward: float, aside: float = 0.0) -> np.ndarray:
    """A unit vector that points down, turned forward and aside [rad]."""
    return np.array([np.sin(aside), np.sin(forward) * np.cos(aside), -np.cos(forward) * np.cos(aside)])


CAMERAS = worlds.ring(4, size=(640, 480), focal=500.0, distance=4.0, target=(0.0, 0.0, 0.9))


def sightings(points: np.ndarray, noise: float = NOISE_PX) -> JointSightings:
    pixels = np.stack([camera.project(points) for camera in CAMERAS], axis=1)
    pixels = pixels + noise * np.random.default_rng(0).normal(size=pixels.shape)
    return JointSightings(joint_names=NAMES, pixels=pixels, confidence=np.ones(pixels.shape[:3]))


def unplaced(factor=1.0):
    found = []
    for camera in CAMERAS:
        matrix = np.array(camera.matrix)
        matrix[:2, :2] *= factor
        found.append(replace(camera, matrix=matrix, camera_from_world=RigidTransform.identity()))
    return found


def bones(sd: float = 0.05) -> BoneLengths:
    return BoneLengths(expected_m=LENGTHS, covariance=sd**2 * np.eye(len(BONES)))


def errors(found, true=CAMERAS):
    """Rotations [rad] and positions [m] after the best similarity, and its scale."""
    turn = sum(b.camera_from_world.rotation.T @ a.camera_from_world.rotation for a, b in zip(found, true, strict=True))
    left, _, right = np.linalg.svd(turn)
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    ours, theirs = np.array([a.centre for a in found]), np.array([b.centre for b in true])
    ours, theirs = (ours - ours.mean(0)) @ turn.T, theirs - theirs.mean(0)
    scale = np.sum(ours * theirs) / np.sum(ours**2)
    off = [
        np.linalg.norm(rotations.log(a.camera_from_world.rotation @ turn.T @ b.camera_from_world.rotation.T))
        for a, b in zip(found, true, strict=True)
    ]
    return np.array(off), np.linalg.norm(scale * ours - theirs, axis=1), scale


@pytest.fixture(scope="module")
def placed():
    return place_cameras(unplaced(1.05), sightings(walker()), bones())


def test_cameras_are_placed_from_focal_lengths_that_are_5_percent_wrong(placed):
    turn, shift, scale = errors(placed.cameras)
    # Three stated standard deviations, which are for errors of 3 px that repeat in all frames; the made ones are 1 px.
    inverse = np.linalg.pinv(block_basis(placed.cameras))
    sd = np.sqrt(np.diag(inverse @ placed.covariance @ inverse.T)).reshape(-1, 7)
    assert np.all(turn < 3 * np.linalg.norm(sd[:, :3], axis=1))
    assert np.all(shift < 3 * np.linalg.norm(sd[:, 3:6], axis=1))
    assert turn.max() < np.deg2rad(0.6)
    assert shift.max() < 0.04
    assert abs(scale - 1) < 3 * placed.scale_sd
    assert placed.undetermined == ()


def test_focal_lengths_are_found(placed):
    focal = np.array([camera.matrix[0, 0] for camera in placed.cameras])
    assert np.abs(focal / 500.0 - 1).max() < 0.02


def test_without_noise_the_cameras_are_exact():
    found = place_cameras(unplaced(), sightings(walker(), noise=0.0), bones())
    turn, shift, _ = errors(found.cameras)
    assert turn.max() < 1e-3
    assert shift.max() < 2e-3


def test_the_world_stands_on_the_floor(placed):
    highest = np.nanmax(placed.points[..., 2])
    assert 1.3 < highest < 1.6
    across = placed.points[:, NAMES.index("right_hip")] - placed.points[:, NAMES.index("left_hip")]
    # The hips of the made person are level.
    assert np.abs(np.nanmedian(across[:, 2])) < 0.02 < 0.15 < np.nanmedian(np.linalg.norm(across, axis=1))


def test_the_mirrored_solution_is_not_chosen(placed):
    """In a mirror image of the world, left and right of the person who walks ahead (Y) are exchanged."""
    known = placed.points[FRAMES // 2]
    right = known[NAMES.index("right_hip")] - known[NAMES.index("left_hip")]
    ahead = placed.points[-1, 3] - placed.points[0, 3]
    assert np.cross([0.0, 0.0, 1.0], right) @ ahead > 0
    assert all(camera.depths(known).min() > 0 for camera in placed.cameras)


def test_joints_in_one_place_do_not_place_a_camera():
    """A point that does not move is one correspondence, whatever its number of frames."""
    points = np.repeat(walker(1)[:, :1], len(NAMES), axis=1)
    found = place_cameras(unplaced(), sightings(np.repeat(points, FRAMES, axis=0)), bones())
    assert found.undetermined
    assert not len(found.points)


@pytest.mark.slow
def test_a_person_who_stands_still_determines_the_cameras_worse(placed):
    """Twelve joints that do not move are twelve correspondences with the constant errors of a detector."""
    still = place_cameras(unplaced(1.05), sightings(walker(moving=False)), bones())
    inverse = [np.linalg.pinv(block_basis(found.cameras)) for found in (placed, still)]
    sd = [
        np.sqrt(np.trace(own @ found.covariance @ own.T))
        for own, found in zip(inverse, (placed, still), strict=True)
    ]  # fmt: skip
    assert still.undetermined or sd[1] > 1.5 * sd[0]


def test_a_camera_that_sees_nobody_is_named():
    seen = sightings(walker())
    confidence = np.array(seen.confidence)
    confidence[:, 2] = 0.0
    found = place_cameras(unplaced(), replace(seen, confidence=confidence), bones())
    assert found.undetermined == (CAMERAS[2].name,)
    assert not len(found.points)


def test_a_single_frame_is_not_enough():
    found = place_cameras(unplaced(), sightings(walker(1)), bones())
    assert len(found.undetermined) == 4


def test_a_pair_has_its_distance_from_the_bones():
    pair = camera_pair(*unplaced()[:2], sightings(walker(), noise=0.0).of_cameras((0, 1)), 2 * LENGTHS)
    assert pair is not None
    distance = np.linalg.norm(CAMERAS[0].centre - CAMERAS[1].centre)
    np.testing.assert_allclose(np.linalg.norm(pair.second_from_first.translation), 2 * distance, rtol=1e-3)


def test_two_cameras_at_one_place_make_no_pair():
    seen = sightings(walker(), noise=0.0).of_cameras((0, 0))
    assert camera_pair(*[unplaced()[0]] * 2, seen, LENGTHS) is None


def test_the_way_of_a_walk_is_horizontal():
    """A walker who leans forward by 10 degrees has Z perpendicular to the way nevertheless."""
    points = walker()
    lean = rotations.exp(np.array([np.deg2rad(-10.0), 0.0, 0.0]))
    middle = points.mean(axis=1, keepdims=True)
    leaning_points = (points - middle) @ lean.T + middle
    up = standing_world(NAMES, leaning_points).rotation[2]
    assert np.degrees(np.arccos(up[2])) < 3.0


def test_scale_uncertainty_of_equal_bones_is_that_of_their_mean():
    np.testing.assert_allclose(bones(0.08).scale_sd, 0.08 / np.sqrt(8))
