"""Uncertainty of slow rotations, limited by the shapes and by the camera's accelerations."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.nonrigid.core.slow_turns import slow_turn_covariance, turned_covariance

FRAMES, POINTS = 100, 12


@pytest.fixture
def shapes(rng):
    """A mean shape and a displacement of changing weight (F, 3, P), of size 1."""
    weights = 0.2 * np.sin(np.arange(FRAMES) / 6)
    shapes = rng.normal(size=(3, POINTS)) + weights[:, None, None] * rng.normal(size=(3, POINTS))
    return shapes - shapes.mean(2, keepdims=True)


def deviation(covariance):
    return np.sqrt(np.einsum("fii->i", covariance) / FRAMES)


def test_a_less_steady_camera_increases_the_uncertainty(shapes):
    steady, unsteady = (slow_turn_covariance(shapes, 0.01, variance) for variance in (1e-12, 1e-4))
    assert (deviation(steady) < deviation(unsteady)).all()


def test_an_object_that_rotates_increases_the_uncertainty(shapes):
    """A displacement with the course of a slow turn is there already: another one with that course costs little."""
    turning = rotations.exp(np.linspace(-0.3, 0.3, FRAMES)[:, None] * np.array([0, 0, 1.0])) @ shapes
    before, after = (deviation(slow_turn_covariance(s, 0.01, 1e-12)) for s in (shapes, turning))
    assert (after > 2 * before).all()


def test_the_variance_of_rotated_shapes_is_that_of_small_rotations(shapes, rng):
    covariance = np.tile(np.diag([1e-4, 4e-4, 9e-4]), (FRAMES, 1, 1))
    turns = rng.normal(size=(4000, 3)) * [0.01, 0.02, 0.03]
    moved = rotations.exp(turns) @ shapes[7]
    np.testing.assert_allclose(turned_covariance(covariance, shapes)[7], moved.var(0), rtol=0.15, atol=1e-6)
