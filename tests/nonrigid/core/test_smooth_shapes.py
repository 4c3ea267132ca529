"""Closed-form shapes, and the nuclear norm."""

import numpy as np

from marey.geometry import rotations
from marey.nonrigid.core.smooth_shapes import _STIFFNESS, nuclear_norm, smooth_shapes


def test_a_rigid_shape_that_turns_is_found_exactly(rng):
    path = rotations.about(np.array([0.0, 1.0, 0.0]), 0.1 * np.arange(60))
    shape = rng.normal(size=(3, 9))
    np.testing.assert_allclose(smooth_shapes((path @ shape)[:, :2], path), np.tile(shape, (60, 1, 1)), atol=1e-9)


def test_the_solution_minimises_its_cost(rng):
    path = rotations.exp(rng.normal(size=(12, 3)))
    tracks = rng.normal(size=(12, 2, 5))

    def total(shapes):
        return np.sum((tracks - (path @ shapes)[:, :2]) ** 2) + _STIFFNESS * np.sum(np.diff(shapes, axis=0) ** 2)

    best = smooth_shapes(tracks, path)
    assert all(total(best) <= total(best + 1e-3 * rng.normal(size=best.shape)) for _ in range(20))


def test_the_nuclear_norm_is_the_sum_of_singular_values(rng):
    shapes = rng.normal(size=(7, 3, 4))
    np.testing.assert_allclose(nuclear_norm(shapes), np.linalg.svd(shapes.reshape(7, -1), compute_uv=False).sum())


def test_rotations_about_the_line_of_sight_give_no_depth(rng):
    path = rotations.about(np.array([0.0, 0.0, 1.0]), 0.1 * np.arange(30))
    shape = rng.normal(size=(3, 9))
    found = smooth_shapes((path @ shape)[:, :2], path)
    np.testing.assert_allclose(found[:, :2], np.tile(shape[:2], (30, 1, 1)), atol=1e-7)
    np.testing.assert_allclose(found[:, 2], 0, atol=1e-6)
