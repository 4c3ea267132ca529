import numpy as np
import trimesh

from marey.knee.space.mesh_graph import MeshGraph
from marey.knee.space.surface import TriangleSurface


def ball(radius: float, fine: int = 4) -> TriangleSurface:
    mesh = trimesh.creation.icosphere(subdivisions=fine, radius=radius)
    return TriangleSurface(vertices_mm=mesh.vertices, faces=mesh.faces)


def test_smoothing_spreads_a_step_over_the_given_width():
    surface = ball(30.0, 5)
    height = surface.vertices_mm[:, 2]
    smooth = MeshGraph.of(surface).smoothed((height > 0).astype(float), 4.0)
    # A step under heat is the normal distribution's: 84 % at one standard deviation.
    at = smooth[np.abs(height - 4.0) < 0.5]
    np.testing.assert_allclose(at.mean(), 0.84, atol=0.04)


def test_filling_takes_the_mean_of_what_is_known_nearby():
    surface = ball(20.0)
    known = surface.vertices_mm[:, 2] > 0
    values = np.where(known, 2.5, np.nan)
    filled = MeshGraph.of(surface).filled(values, known.astype(float), 2.0)
    np.testing.assert_allclose(filled[surface.vertices_mm[:, 2] > -2], 2.5)
    assert np.isnan(filled[surface.vertices_mm[:, 2] < -18]).all()


def test_the_slopes_along_edges_are_those_of_a_plane_and_ignore_unused_vertices():
    flat = trimesh.creation.box((20, 20, 4)).subdivide().subdivide().subdivide()
    surface = TriangleSurface(vertices_mm=flat.vertices, faces=flat.faces)
    top = surface.vertices_mm[:, 2] > 1.9
    graph = MeshGraph.of(surface)
    slopes = [graph.slopes(np.where(top, 0.3 * surface.vertices_mm[:, axis], 9.0), top) for axis in (0, 1)]
    # Of a plane, the squared slopes along two directions at right angles add to the squared gradient.
    assert not slopes[0][~top].any()
    np.testing.assert_allclose((slopes[0] ** 2 + slopes[1] ** 2)[top], 0.3**2)


def test_the_choice_is_the_cheapest_of_all_on_a_chain(rng):
    # A strip of triangles whose second row is free: belief propagation against all 4^5 choices would need a tree; here
    # every vertex has its own cheapest label, and the cost of a pair is the difference of its labels.
    levels = np.array([0.0, 1.0, 2.0, 3.0])
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    graph = MeshGraph(edges, np.ones(4), 5)
    costs = rng.uniform(0, 3, (5, 4))
    chosen = np.argmin(graph.choose(costs, levels, 0.8, 1.5), axis=1)

    def whole(choice: tuple[int, ...]) -> float:
        steps = np.diff(levels[list(choice)])
        return float(costs[range(5), choice].sum() + np.minimum(0.5 * (steps / 0.8) ** 2, 1.5).sum())

    best = min(np.ndindex(4, 4, 4, 4, 4), key=whole)
    np.testing.assert_array_equal(chosen, best)


def test_one_vertex_that_strays_is_brought_back_by_its_neighbours():
    surface = ball(10.0, 3)
    levels = np.arange(0.0, 4.01, 0.5)
    costs = np.tile(0.5 * ((levels - 2.0) / 0.3) ** 2, (len(surface.vertices_mm), 1))
    costs[7] = 0.5 * ((levels - 4.0) / 0.6) ** 2
    beliefs = MeshGraph.of(surface).choose(costs, levels, 0.25, 3.0)
    assert (levels[np.argmin(beliefs, axis=1)] == 2.0).all()
