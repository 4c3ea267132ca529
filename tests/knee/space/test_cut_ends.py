import numpy as np
import trimesh
from tests.made_bones import made_bone

from marey.knee.space.cut_ends import cut_planes, known_faces, known_points
from marey.knee.space.surface import TriangleSurface


def test_the_flat_end_of_a_shaft_is_found_and_nothing_else():
    (cut,) = cut_planes(made_bone(shaft_mm=60.0))
    # Faces of the edge lean a little and count, too.
    np.testing.assert_allclose(cut.normal, (0, 0, 1), atol=1e-3)
    np.testing.assert_allclose(cut.point_mm[2], 60.0, atol=1e-2)


def test_a_whole_rounded_bone_has_no_flat_end():
    ball = trimesh.creation.icosphere(subdivisions=4)
    assert cut_planes(TriangleSurface(vertices_mm=ball.vertices * (45, 30, 20), faces=ball.faces)) == ()


def test_faces_near_the_cut_and_at_open_rims_are_not_the_bones_own():
    bone = made_bone(shaft_mm=60.0)
    middle = bone.corners_mm.mean(1)
    known = known_faces(bone, cut_planes(bone), 5.0)
    away = np.abs(middle[:, 2] - 55.0) > 0.1
    np.testing.assert_array_equal(known[away], middle[away, 2] < 55.0)
    open_bone = TriangleSurface(vertices_mm=bone.vertices_mm, faces=bone.faces[middle[:, 2] < 40])
    rim = ~known_faces(open_bone, (), 0.0)
    assert rim.any()
    assert open_bone.corners_mm[rim].max(1)[:, 2].min() > 30.0
    np.testing.assert_array_equal(
        known_points(np.array([[0.0, 0, 10], [0, 0, 58]]), cut_planes(bone), 5.0), [True, False]
    )
