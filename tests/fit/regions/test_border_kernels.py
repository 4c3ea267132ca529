"""Borders of drawn parts in the normal equations of a pose."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose, PosedBody
from marey.fit.regions.border_kernels import MOMENTS, _add_face, _add_segment
from marey.fit.regions.region_search import _rest

STEP = 1e-6
"""Change of a coordinate in the derivatives [rad or m]."""


@pytest.mark.parametrize("axis", [0, 1])
def test_a_border_moves_as_its_point_does(rng, axis):
    camera, body = worlds.ring(size=(100, 120), focal=150.0)[0], worlds.person()
    posed, degrees = PosedBody(body, worlds.pose(body)), len(body.skeleton)
    (information, pull), area, focal = (0.7, -0.3), 2.0, camera.matrix[0, 0]
    views = (camera.packed[None], None, None, np.array([focal]))
    canvas = (None, None, None, None, np.array([area]), posed.vertices)
    segments = (posed.segment_rotation, posed.segment_origin, posed.world_axes)

    def place(pose: Pose, face: int) -> float:
        """Return the column or the row of the middle of a face without the distortion of the lens [px]."""
        point = PosedBody(body, pose).vertices[body.faces[face]].mean(axis=0)
        seen = camera.packed[:9].reshape(3, 3) @ point + camera.packed[9:12]
        return float(focal * seen[axis] / seen[2])

    # Faces beside joints move with two segments, their borders with one.
    rigid = np.flatnonzero((body.vertex_weights.max(axis=1) == 1.0)[body.faces].all(axis=1))
    for face in rng.choice(rigid, 5, replace=False):
        sums = np.zeros(4)
        sums[2 * axis : 2 * axis + 2] = information, pull
        moments, segment = np.zeros((MOMENTS, MOMENTS)), int(body.face_segment[face])
        _add_face(body.faces[face], views, canvas, 0, sums, moments)
        hessian, gradient = np.zeros((degrees, degrees)), np.zeros(degrees)
        _add_segment(_rest(body), segments, segment, moments, hessian, gradient)
        steps = STEP * np.eye(degrees)
        derivative = np.array(
            [(place(posed.pose.step(step), face) - place(posed.pose.step(-step), face)) / (2 * STEP) for step in steps]
        )
        # Places of about 100 px, rounded to 1e-14 px each, over twice the step, in products of up to 300 px.
        np.testing.assert_allclose(gradient, -area * pull * derivative, atol=1e-5)
        np.testing.assert_allclose(hessian, area * information * np.tril(np.outer(derivative, derivative)), atol=1e-3)
