import numpy as np
import pytest
from tests import worlds

from marey.cameras.parameters import (
    PARAMETER_NAMES,
    PARAMETERS,
    focal_basis,
    pose_basis,
    project_with_slopes,
    stepped_camera,
)

POINTS = np.array([[0.1, 0.2, 0.3], [-0.4, 0.3, -0.5], [0.2, -0.5, 0.6]])


@pytest.fixture(params=[(), (-0.1, 0.05, 0.003, -0.002), (-0.2, 0.1, 0.003, -0.002, 0.04)], ids=len)
def camera(request):
    from dataclasses import replace

    plain = worlds.looking_at(np.zeros(3), np.array([2.0, 1.0, 0.4]))
    return replace(plain, distortion=np.array(request.param))


def test_the_slopes_are_the_differences_of_stepped_cameras(camera):
    _, _, slopes = project_with_slopes(camera, POINTS)
    for k, name in enumerate(PARAMETER_NAMES):
        step = np.zeros(PARAMETERS)
        step[k] = 1e-3 if name in ("fx", "fy", "cx", "cy") else 1e-6
        there, back = (stepped_camera(camera, sign * step).project(POINTS) for sign in (1, -1))
        np.testing.assert_allclose((there - back) / (2 * step[k]), slopes[:, :, k], rtol=1e-4, atol=1e-4, err_msg=name)


def test_the_pixels_and_their_slopes_by_the_points_are_those_of_the_camera(camera):
    pixels, by_point, _ = project_with_slopes(camera, POINTS)
    seen, slope = camera.project_with_derivative(POINTS)
    np.testing.assert_array_equal(pixels, seen)
    np.testing.assert_array_equal(by_point, slope)


def test_the_basis_of_a_pose_turns_about_the_centre_and_shifts_the_centre(camera):
    basis = pose_basis(camera)
    turned = stepped_camera(camera, basis @ np.array([1e-4, -2e-4, 1e-4, 0, 0, 0]))
    np.testing.assert_allclose(turned.centre, camera.centre, atol=1e-6)
    shift = np.array([0.01, -0.02, 0.03])
    shifted = stepped_camera(camera, basis[:, 3:] @ shift)
    np.testing.assert_allclose(shifted.centre - camera.centre, shift, atol=1e-12)
    np.testing.assert_array_equal(shifted.camera_from_world.rotation, camera.camera_from_world.rotation)


def test_the_basis_of_the_focal_length_is_a_share_of_it(camera):
    longer = stepped_camera(camera, focal_basis(camera)[:, 0] * 0.05)
    np.testing.assert_allclose(np.diag(longer.matrix)[:2], 1.05 * np.diag(camera.matrix)[:2])
