"""Cameras refined with the motion of a person."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.cameras.parameters import pose_basis, stepped_camera
from marey.fit.cameras.refine import CameraPrior, prior_basis, refine_cameras
from marey.fit.recipes.person import PersonSettings, SilhouetteTake
from marey.geometry import rotations

FRAMES = 12


@pytest.fixture(scope="module")
def world():
    body, cameras = worlds.person("fine"), worlds.ring()
    truth = [PosedBody(body, pose) for pose in worlds.swing(body, FRAMES)]
    masks = worlds.seen(truth, cameras)
    return body, cameras, truth, masks


def refined(world, change, priors, *, rounds=6):
    body, cameras, truth, masks = world
    moved = tuple(stepped_camera(camera, pose_basis(camera) @ own) for camera, own in zip(cameras, change, strict=True))
    take = SilhouetteTake(moved, lambda frame: masks[frame], tuple(range(FRAMES)), worlds.RATE)
    poses = {frame: posed.pose for frame, posed in enumerate(truth)}
    return refine_cameras(take, body, poses, (), PersonSettings(), priors=priors, height=240.0, rounds=rounds)


@pytest.mark.slow
def test_a_displaced_camera_returns_to_its_place_within_its_stated_uncertainty(world):
    change, prior = np.zeros((4, 6)), CameraPrior(turn_rad=0.05, shift_m=0.2)
    change[2] = [0.01, -0.008, 0.006, 0.02, -0.015, 0.01]
    found = refined(world, change, [prior if c == 2 else CameraPrior() for c in range(4)])
    true, own = world[1][2], found.cameras[2]
    turn = rotations.log(own.camera_from_world.rotation @ true.camera_from_world.rotation.T)
    assert np.degrees(np.linalg.norm(turn)) < 0.3
    assert np.linalg.norm(own.centre - true.centre) < 0.015
    inverse = np.linalg.pinv(pose_basis(own))
    covariance = inverse @ found.covariance[30:45, 30:45] @ inverse.T
    error = np.r_[turn, own.centre - true.centre]
    assert error @ np.linalg.solve(covariance, error) < 22.5
    assert found.undetermined == ()
    assert not found.covariance[:30, :30].any()
    assert all(
        found.cameras[c] is world[1][c] or np.array_equal(found.cameras[c].packed, world[1][c].packed)
        for c in (0, 1, 3)
    )


def test_a_camera_that_the_take_does_not_determine_is_named(world):
    prior = CameraPrior(turn_rad=1e-4, shift_m=1e-4)
    found = refined(world, np.zeros((4, 6)), [prior, *[CameraPrior()] * 3], rounds=2)
    assert found.undetermined == (world[1][0].name,)


def test_the_basis_has_one_column_for_each_unknown(world):
    priors = [CameraPrior(turn_rad=0.1), CameraPrior(), CameraPrior(focal=0.05), CameraPrior(shift_m=0.2)]
    basis = prior_basis(world[1], priors)
    assert basis.shape == (60, 7)
    assert not basis[15:30].any()
    np.testing.assert_allclose(basis[30, 3], 0.05 * world[1][2].matrix[0, 0])


@pytest.mark.slow
def test_all_cameras_are_refined_while_the_whole_stays_in_place(world):
    rng = np.random.default_rng(4)
    change = np.concatenate([rng.normal(size=(4, 3)) * 0.004, rng.normal(size=(4, 3)) * 0.008], axis=1)
    found = refined(world, change, [CameraPrior(turn_rad=0.02, shift_m=0.03)] * 4)
    before = [stepped_camera(c, pose_basis(c) @ own) for c, own in zip(world[1], change, strict=True)]
    # The sum of the shifts, in units of their standard deviation, is zero in first order; so is the scale.
    shifts = np.array([new.centre - old.centre for new, old in zip(found.cameras, before, strict=True)])
    middle = np.mean([camera.centre for camera in before], axis=0)
    arms = np.array([camera.centre - middle for camera in before])
    assert np.linalg.norm(shifts.sum(axis=0)) < 2e-3
    assert abs(np.sum(shifts * arms)) / np.sum(arms**2) < 1e-3

    def relative(cameras):
        first = cameras[0].camera_from_world
        return [
            np.degrees(np.linalg.norm((camera.camera_from_world @ first.inverse()).rotation_vector - own))
            for camera, own in zip(
                cameras[1:],
                [(c.camera_from_world @ world[1][0].camera_from_world.inverse()).rotation_vector for c in world[1][1:]],
                strict=True,
            )
        ]

    assert np.mean(relative(found.cameras)) < 0.6 * np.mean(relative(before))
    assert np.linalg.matrix_rank(found.covariance, tol=1e-14) <= 17
