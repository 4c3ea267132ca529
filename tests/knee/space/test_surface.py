import numpy as np
import trimesh

from marey.knee.space.surface import TriangleSurface


def test_a_ball_has_its_area_its_volume_and_outward_normals():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    surface = TriangleSurface(vertices_mm=ball.vertices + (3, 4, 5), faces=ball.faces)
    # An inscribed polyhedron of 5120 faces is smaller by about the square of an edge over its radius.
    np.testing.assert_allclose(surface.area_mm2, 4 * np.pi * 100, rtol=5e-3)
    np.testing.assert_allclose(surface.volume_mm3, 4 / 3 * np.pi * 1000, rtol=5e-3)
    # Faces about a vertex lean by up to the angle of an edge, 4 degrees; most of that evens out.
    np.testing.assert_allclose(surface.vertex_normals, ball.vertices / 10, atol=np.radians(4) / 4)
    inside_out = TriangleSurface(vertices_mm=surface.vertices_mm, faces=surface.faces[:, ::-1])
    np.testing.assert_allclose(inside_out.volume_mm3, -surface.volume_mm3)
