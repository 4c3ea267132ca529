import numpy as np
import trimesh
from tests.made_bones import made_bone

from marey.knee.space.mesh_repair import consistently_oriented, joined, with_holes_closed
from marey.knee.space.surface import TriangleSurface


def test_single_faces_and_whole_pieces_that_turn_inward_are_turned_outward(rng):
    bone = made_bone(fine=3)
    faces = np.concatenate([bone.faces, bone.faces + len(bone.vertices_mm)])
    vertices = np.concatenate([bone.vertices_mm, bone.vertices_mm + (200, 0, 0)])
    wrong = rng.random(len(faces)) < 0.2
    wrong[len(bone.faces) :] |= True  # the second piece is inside out
    mixed = np.where(wrong[:, None], faces[:, ::-1], faces)
    repaired, turned = consistently_oriented(TriangleSurface(vertices_mm=vertices, faces=mixed))
    np.testing.assert_array_equal(turned, wrong)
    np.testing.assert_array_equal(repaired.faces, faces)


def test_single_triangles_are_joined_by_the_positions_of_their_corners():
    bone = made_bone(fine=3)
    soup = TriangleSurface(
        vertices_mm=bone.corners_mm.reshape(-1, 3), faces=np.arange(3 * len(bone.faces)).reshape(-1, 3)
    )
    faces = soup.faces.copy()
    faces[7] = faces[7, ::-1]
    repaired, turned = consistently_oriented(TriangleSurface(vertices_mm=soup.vertices_mm, faces=faces))
    assert np.flatnonzero(turned).tolist() == [7]
    np.testing.assert_array_equal(repaired.faces, soup.faces)
    assert len(joined(soup).vertices_mm) == len(np.unique(bone.vertices_mm, axis=0))
    np.testing.assert_allclose(joined(soup).volume_mm3, bone.volume_mm3)


def test_a_sound_mesh_stays_as_it_is():
    bone = made_bone(fine=3)
    same, turned = consistently_oriented(bone)
    assert not turned.any()
    np.testing.assert_array_equal(same.faces, bone.faces)


def test_a_hollow_within_turns_inward():
    ball = trimesh.creation.icosphere(subdivisions=2)
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    vertices = np.concatenate([18.0 * ball.vertices, 20.0 * ball.vertices])
    _, turned = consistently_oriented(TriangleSurface(vertices_mm=vertices, faces=faces))
    np.testing.assert_array_equal(turned, np.arange(len(faces)) < len(ball.faces))


def test_small_holes_are_closed_and_wide_ones_are_counted():
    bone = made_bone(fine=3)
    inner = bone.corners_mm[:, :, 2].max(1) < 10
    rng = np.random.default_rng(0)
    gone = inner & (rng.random(len(inner)) < 0.01)
    holed = TriangleSurface(vertices_mm=bone.vertices_mm, faces=bone.faces[~gone])
    whole, closed, left = with_holes_closed(holed, 30)
    assert left == 0
    assert 0 < closed <= gone.sum()
    np.testing.assert_allclose(whole.volume_mm3, bone.volume_mm3, rtol=1e-3)
    assert len(whole.faces) == len(bone.faces)
    wide = TriangleSurface(vertices_mm=bone.vertices_mm, faces=bone.faces[bone.corners_mm[:, :, 2].mean(1) < 20])
    same, closed, left = with_holes_closed(wide, 10)
    assert closed == 0
    assert left > 10
    np.testing.assert_array_equal(same.faces, wide.faces)
