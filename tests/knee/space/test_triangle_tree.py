import numpy as np
import pytest
import trimesh

from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree


@pytest.fixture
def potato(rng) -> TriangleSurface:
    ball = trimesh.creation.icosphere(subdivisions=3)
    bumps = 10 + 2 * np.sin(3 * ball.vertices[:, :1]) * np.cos(4 * ball.vertices[:, 1:2])
    return TriangleSurface(vertices_mm=ball.vertices * bumps * (1, 1.6, 0.8), faces=ball.faces)


def barycentric_nearest(point: np.ndarray, corners: np.ndarray) -> float:
    """The distance of a point from a triangle: of the plane's foot if it lies within, else of the nearest side."""
    a, b, c = corners
    sides = [(a, b), (b, c), (c, a)]
    best = np.inf
    for start, end in sides:
        share = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
        best = min(best, np.linalg.norm(start + share * (end - start) - point))
    share = np.linalg.lstsq(np.stack([b - a, c - a], 1), point - a, rcond=None)[0]
    if (share >= 0).all() and share.sum() <= 1:
        best = min(best, np.linalg.norm(a + np.stack([b - a, c - a], 1) @ share - point))
    return float(best)


@pytest.mark.slow
def test_the_nearest_point_is_that_of_all_triangles(potato: TriangleSurface, rng):
    points = rng.normal(0, 15, (15, 3))
    found = TriangleTree.of(potato).nearest(points)
    for n, point in enumerate(points):
        wanted = min(barycentric_nearest(point, corners) for corners in potato.corners_mm)
        np.testing.assert_allclose(found.distance_mm[n], wanted, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(found.points_mm[n] - point), wanted, atol=1e-9)
        np.testing.assert_allclose(
            barycentric_nearest(found.points_mm[n], potato.corners_mm[found.face[n]]), 0, atol=1e-9
        )


def test_beyond_reach_nothing_is_found_and_within_it_the_same(potato: TriangleSurface, rng):
    points = rng.normal(0, 15, (300, 3))
    tree = TriangleTree.of(potato)
    every, near = tree.nearest(points), tree.nearest(points, 4.0)
    within = every.distance_mm < 4.0
    assert 0.1 < within.mean() < 0.9
    np.testing.assert_array_equal(near.face, np.where(within, every.face, -1))
    np.testing.assert_array_equal(near.points_mm[within], every.points_mm[within])
    assert np.isinf(near.distance_mm[~within]).all()
    assert np.isnan(near.points_mm[~within]).all()


def test_a_ray_from_within_leaves_once_more_than_it_enters(potato: TriangleSurface, rng):
    directions = rng.normal(0, 1, (200, 3))
    crossed = TriangleTree.of(potato).crossings(np.zeros((200, 3)), directions, 100.0)
    assert (crossed.leaving.sum(1) == 1).all()
    assert (np.diff(crossed.distance_mm, axis=1)[:, 0][crossed.leaving[:, 1] != 0] >= 0).all()


def test_rays_through_corners_and_edges_cross_once():
    box = trimesh.creation.box((2, 2, 2)).subdivide().subdivide()
    tree = TriangleTree.of(TriangleSurface(vertices_mm=box.vertices, faces=box.faces))
    x, y = np.meshgrid(np.linspace(-0.75, 0.75, 7), np.linspace(-0.75, 0.75, 7))
    starts = np.stack([x.ravel(), y.ravel(), np.full(x.size, -5.0)], 1)
    crossed = tree.crossings(starts, np.tile([0.0, 0, 3], (len(starts), 1)), 20.0)
    np.testing.assert_array_equal(crossed.leaving[:, :3], np.tile([-1, 1, 0], (len(starts), 1)))
    np.testing.assert_allclose(crossed.distance_mm[:, :2], np.tile([4.0, 6.0], (len(starts), 1)))


def test_reach_ends_a_ray_and_a_ray_without_direction_crosses_nothing(potato: TriangleSurface):
    tree = TriangleTree.of(potato)
    assert not tree.crossings(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), 1.0).leaving.any()
    assert not tree.crossings(np.zeros((1, 3)), np.zeros((1, 3)), 100.0).leaving.any()
