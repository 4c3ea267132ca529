"""Clicked joint centres: zero residual at the click, no contribution behind the camera."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.observations.joint_point import JointPoints


@pytest.fixture
def posed():
    body = worlds.person()
    return PosedBody(body, worlds.pose(body))


def clicked(posed, camera, off=0.0):
    segments = posed.body.joint_segments
    pixels = camera.project(posed.segment_origin[segments]) + off
    return JointPoints(camera=camera, segments=segments, pixels=pixels, sigma_px=4.0)


def test_a_click_on_the_joint_has_no_residual_and_one_beside_it_has_its_distance(posed):
    camera = worlds.ring(1)[0]
    np.testing.assert_allclose(clicked(posed, camera).linearize(posed).residual, 0, atol=1e-9)
    beside = clicked(posed, camera, np.array([3.0, -2.0]))
    np.testing.assert_allclose(beside.linearize(posed).residual.reshape(-1, 2), [[-3.0, 2.0]] * 16, atol=1e-9)
    np.testing.assert_allclose(beside.whiten(posed).residual.reshape(-1, 2), [[-0.75, 0.5]] * 16, atol=1e-9)


def test_a_joint_behind_the_camera_contributes_nothing(posed):
    camera = worlds.looking_at(np.array([0.0, 5.0, 0.3]), np.array([0.0, 0.3, 0.3]))
    segments = posed.body.joint_segments
    depths = camera.depths(posed.segment_origin[segments])
    assert (depths < 0).all()
    behind = JointPoints(camera=camera, segments=segments, pixels=np.zeros((16, 2)), sigma_px=4.0)
    for shape in (False, True):
        model = behind.linearize(posed, shape=shape)
        np.testing.assert_array_equal(model.residual, 0)
        np.testing.assert_array_equal(model.jacobian, 0)
