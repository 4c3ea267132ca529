"""Paths of rotations: derivatives, smoothing, and mirrored paths of rigid objects."""

import numpy as np

from marey.geometry import rotations
from marey.nonrigid.core.rotation_paths import acceleration_jacobians, accelerations, mirrored_after, smoothed_path


def turning(frames, degrees):
    return rotations.about(np.array([0.0, 1.0, 0.0]), np.radians(degrees) * np.arange(frames))


def test_the_derivatives_of_accelerations_agree_with_differences(rng):
    path = rotations.exp(np.cumsum(0.02 * rng.normal(size=(3, 3)), 0))
    jacobians = acceleration_jacobians(path)
    for k in range(3):
        for axis in range(3):
            moved = path.copy()
            moved[k] = rotations.exp(1e-6 * np.eye(3)[axis]) @ path[k]
            change = (accelerations(moved) - accelerations(path))[0] / 1e-6
            # the left Jacobian of the turn from frame to frame is taken as 1: that turn is 0.03 here
            np.testing.assert_allclose(change, jacobians[k][0][:, axis], atol=0.06)


def test_a_steady_rotation_has_no_acceleration_and_is_not_changed_by_smoothing():
    path = turning(40, 5)
    np.testing.assert_allclose(accelerations(path), 0, atol=1e-12)
    np.testing.assert_allclose(smoothed_path(path, 1e8), path, atol=1e-8)


def test_smoothing_removes_noise_about_a_steady_rotation(rng):
    path = turning(200, 5)
    noisy = rotations.exp(0.05 * rng.normal(size=(200, 3))) @ path
    steady = smoothed_path(noisy, 1e8)
    assert np.abs(accelerations(steady)).max() < 1e-4
    assert np.linalg.norm(rotations.log(steady @ np.swapaxes(path, 1, 2)), axis=1).max() < 0.03
    np.testing.assert_array_equal(smoothed_path(noisy, 0), noisy)


def test_rigid_tracks_look_the_same_from_the_mirrored_path(rng):
    path, points = turning(30, 4), rng.normal(size=(3, 8))
    mirrored = mirrored_after(path, 12)
    np.testing.assert_allclose(mirrored[:13], path[:13], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(mirrored), 1)
    # from frame 12 on the other path shows the mirror image of the shape in frame 12's depth
    other = path[12].T @ np.diag([1.0, 1, -1]) @ path[12] @ points
    np.testing.assert_allclose((mirrored @ other)[12:, :2], (path @ points)[12:, :2], atol=1e-12)
