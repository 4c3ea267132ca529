"""The model before several cameras: derivatives, and frames that a camera does not see."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.nonrigid.core.deforming_model import initial_model, refine, residuals_and_jacobians

FRAMES, POINTS = 12, 7


@pytest.fixture
def made(rng):
    """Two cameras that stand apart: model, tracks (F, 4, P), seen (F, 2, P)."""
    turn = rotations.exp(np.array([0.1, 0.7, -0.2]))
    projection = np.concatenate([np.eye(3)[:2], 1.3 * turn[:2]])
    time = np.arange(FRAMES)
    path = rotations.exp(np.outer(0.1 * time, [0.2, 1.0, 0.1]))
    swing = 0.3 * np.sin(time / 3)[:, None, None]
    shapes = rng.normal(size=(3, POINTS)) + swing * rng.normal(size=(3, POINTS))
    tracks = projection @ path @ shapes + rng.normal(size=(FRAMES, 4, 1))
    seen = np.asarray(rng.random((FRAMES, 2, POINTS)) < 0.8, float)
    return initial_model(tracks, seen, path, shapes, 2, 0.01, projection), tracks, seen


def test_the_derivatives_are_those_of_the_residuals(made):
    model, tracks, seen = made
    _, jacobian = residuals_and_jacobians(model, tracks, seen)
    turn, shift, weights = model.rotation, model.shift, model.weights
    for unknown in range(jacobian.shape[-1]):
        step = np.zeros(jacobian.shape[-1])
        step[unknown] = 1e-6
        sides = []
        for sign in (1, -1):
            model.rotation = rotations.exp(sign * step[:3]) @ turn
            model.shift, model.weights = shift + sign * step[3:7], weights + sign * step[7:]
            sides.append(residuals_and_jacobians(model, tracks, seen)[0])
        np.testing.assert_allclose(-(sides[0] - sides[1]) / 2e-6, jacobian[..., unknown], atol=1e-7)


def test_frames_that_a_camera_does_not_see_do_not_affect_it(made):
    model, tracks, seen = made
    seen[3:6, 1] = 0
    refine(model, np.where(np.repeat(seen, 2, axis=1) > 0, tracks, 1e3), seen, 3)
    assert np.isfinite(model.cost)
    assert np.abs(model.shift[3:6, 2:]).max() < 10
