"""The border of the normal equations by the cameras, against moved cameras and moved worlds."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.cameras.parameters import PARAMETERS, pose_basis, stepped_camera
from marey.fit.recipes.sequence import refine_sequence
from marey.fit.solver.camera_terms import CameraUnknowns, with_cameras
from marey.fit.solver.pose_solver import match_cameras
from marey.observations.correspondence import ObservedOutline, OutlineMatchSettings


@pytest.fixture(scope="module")
def standing():
    body, cameras = worlds.person(), worlds.ring()
    return body, cameras, PosedBody(body, worlds.pose(body))


def all_poses(cameras, estimated=False):
    """Unknowns for the poses of all cameras, in metres and radians."""
    basis = np.zeros((PARAMETERS * len(cameras), 6 * len(cameras)))
    for c, camera in enumerate(cameras):
        basis[PARAMETERS * c : PARAMETERS * (c + 1), 6 * c : 6 * (c + 1)] = pose_basis(camera)
    return CameraUnknowns(cameras=cameras, basis=basis, offset=np.zeros(6 * len(cameras)), estimated=estimated)


@pytest.mark.parametrize("residual", ["plane", "ray"])
def test_the_gradient_is_that_of_the_residuals_of_moved_cameras(standing, residual):
    body, cameras, posed = standing
    masks = worlds.silhouettes(posed, cameras)
    outlines = [ObservedOutline.of(camera, mask) for camera, mask in zip(cameras, masks, strict=True)]
    moved = replace(posed, pose=posed.pose.step(np.r_[0.004, -0.003, 0.002, np.zeros(len(body.skeleton) - 3)]))
    seen = match_cameras(moved, outlines, OutlineMatchSettings(residual=residual), 1e6)
    cross, own, pull = all_poses(cameras).terms(moved, seen, shape=False)
    assert cross.shape == (len(body.skeleton), 24)
    np.testing.assert_allclose(own, own.T, atol=1e-9 * np.abs(own).max())
    # A shift of all cameras by d is a shift of the body by -d: for planes through the centres, exactly.
    shifts = np.concatenate([np.eye(3) if k % 6 == 3 else np.zeros((0, 3)) for k in range(24)])
    columns = np.array([6 * c + 3 + k for c in range(4) for k in range(3)])
    np.testing.assert_allclose(cross[:3, columns] @ shifts, -_information(seen, moved)[:3, :3], rtol=2e-2)
    assert np.abs(pull).max() > 0


def _information(seen, posed):
    total = 0.0
    for found, weights in seen:
        for match, weight in zip(found, weights, strict=True):
            row = match.linearize(posed)
            share = np.repeat(weight, len(row.residual) // len(weight)) / match.sigma**2
            total = total + row.jacobian.T @ (row.jacobian * share[:, None])
    return total


def test_the_unknowns_stand_behind_those_that_a_frame_lacks():
    hessian, gradient = np.full((2, 2), 3.0), np.ones(2)
    terms = np.full((2, 1), 5.0), np.full((1, 1), 7.0), np.full(1, 2.0)
    whole, right = with_cameras(hessian, gradient, terms, size=3)
    np.testing.assert_array_equal(whole, [[3, 3, 0, 5], [3, 3, 0, 5], [0, 0, 0, 0], [5, 5, 0, 7]])
    np.testing.assert_array_equal(right, [1, 1, 0, 2])


def test_a_covariance_is_that_of_its_unknowns(rng):
    root = rng.normal(size=(PARAMETERS, 4)) * np.geomspace(1, 1e-6, PARAMETERS)[:, None]
    covariance = root @ root.T
    unknowns = CameraUnknowns.of_covariance(worlds.ring()[:1], covariance)
    np.testing.assert_allclose(unknowns.basis @ unknowns.basis.T, covariance, rtol=1e-6, atol=1e-18)
    assert len(unknowns) <= 8


def test_an_unknown_of_one_camera_steps_that_camera_only():
    cameras = worlds.ring()
    basis = np.zeros((PARAMETERS * 4, 1))
    basis[PARAMETERS + 12] = 0.01
    unknowns = CameraUnknowns(cameras=cameras, basis=basis, offset=np.zeros(1), estimated=True)
    stepped = unknowns.stepped(np.array([2.0]))
    assert [a is b for a, b in zip(stepped, cameras, strict=True)] == [True, False, True, True]
    expected = stepped_camera(cameras[1], np.eye(PARAMETERS)[12] * 0.02)
    np.testing.assert_array_equal(stepped[1].packed, expected.packed)


@pytest.fixture(scope="module")
def refined():
    """A motion refined without and with cameras whose common position is uncertain by 5 mm along X."""
    body, cameras = worlds.person(), worlds.ring()
    truth = [PosedBody(body, pose) for pose in worlds.swing(body, 5)]
    levels = worlds.levels(truth, cameras)
    columns = np.concatenate([pose_basis(camera)[:, 3] for camera in cameras])[:, None] * 0.005
    unknowns = CameraUnknowns(cameras=cameras, basis=columns, offset=np.zeros(1), estimated=False)
    poses = [p.pose for p in truth]
    return [
        refine_sequence(range(5), poses, body, levels, rate=30, rounds=2, shape_frames=shape, cameras=own)
        for own in (None, unknowns)
        for shape in ((), (0, 2, 4))
    ]


def test_a_common_shift_of_all_cameras_shifts_the_person_by_as_much(refined):
    plain, plain_shape, with_error, with_error_shape = refined
    for before, after in ((plain, with_error), (plain_shape, with_error_shape)):
        # The columns of the cameras change the rounding of the solution, and nothing else.
        np.testing.assert_allclose(before.poses[2].angles, after.poses[2].angles, rtol=0, atol=1e-12)
        added = (after.covariance - before.covariance)[2]
        np.testing.assert_allclose(added[0, 0], 0.005**2, rtol=0.02)
        assert np.abs(np.diag(added)[1 : len(after.body.skeleton)]).max() < 0.02 * 0.005**2 * 100
        assert np.all(np.diag(added)[: len(after.body.skeleton)] >= 0)
