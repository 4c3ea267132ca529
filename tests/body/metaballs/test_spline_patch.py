"""B-spline patches."""

import numpy as np
import pytest

from marey.body.metaballs.spline_patch import SplinePatch, chord_lengths, curve_at


def tube(around: np.ndarray, along: np.ndarray) -> np.ndarray:
    """A horn of radius 0.1 to 0.05 m."""
    radius = 0.1 - 0.05 * along[:, None] ** 2
    x, y = radius * np.cos(around), radius * np.sin(around)
    return np.stack([x, y, np.broadcast_to(along[:, None], x.shape)], -1)


@pytest.fixture
def patch() -> SplinePatch:
    turn, along = np.linspace(0, 2 * np.pi, 25), np.linspace(0, 1, 9)
    return SplinePatch(around=turn, along=along, points=tube(turn[:-1], along))


def test_a_patch_meets_its_points(patch):
    np.testing.assert_allclose(patch.at(patch.around[:-1], patch.along), patch.points, atol=1e-15)


def test_a_patch_follows_a_smooth_surface_between_its_points(patch, rng):
    around, along = rng.uniform(0, 2 * np.pi, 40), rng.uniform(0, 1, 40)
    error = np.abs(patch.at(around, along) - tube(around, along)).max()
    # A cubic spline through points h apart errs by 5/384 h^4 of the fourth derivative, here 0.1 m.
    assert error < 2 * 5 / 384 * (2 * np.pi / 24) ** 4 * 0.1


def test_a_patch_closes_smoothly(patch):
    step = 1e-4
    before, at, after = patch.at(np.array([2 * np.pi - step, 0.0, step]), np.array([0.3]))[0]
    np.testing.assert_allclose(at - before, after - at, atol=2 * 0.1 * step**2)


def test_control_points_would_lie_inside_by_a_sixth_of_the_curvature(patch):
    ring = patch.points[0]
    blended = (np.roll(ring, 1, axis=0) + 4 * ring + np.roll(ring, -1, axis=0)) / 6
    inside = 0.1 - np.linalg.norm(blended[:, :2], axis=1)
    spacing = np.linalg.norm(ring[1] - ring[0])
    np.testing.assert_allclose(inside, spacing**2 / 0.1 / 6, rtol=0.02)


def test_a_curve_meets_its_points():
    points = np.random.default_rng(1).normal(size=(7, 3))
    np.testing.assert_allclose(curve_at(np.arange(7.0), points, np.arange(7.0)), points, atol=1e-12)


def test_rows_are_as_far_apart_as_their_chords(patch):
    length = chord_lengths(patch.points)
    assert length[0] == 0
    assert 1.0 < length[-1] < 1.01
