import numpy as np
from tests.made_bones import made_bone

from marey.knee.orientation import joined, turned_alike
from marey.knee.surface import Surface


def test_single_faces_and_whole_pieces_that_turn_inward_are_turned_outward(rng):
    bone = made_bone(fine=3)
    faces = np.concatenate([bone.faces, bone.faces + len(bone.vertices_mm)])
    vertices = np.concatenate([bone.vertices_mm, bone.vertices_mm + (200, 0, 0)])
    wrong = rng.random(len(faces)) < 0.2
    wrong[len(bone.faces) :] |= True  # the second piece is inside out
    mixed = np.where(wrong[:, None], faces[:, ::-1], faces)
    mended, turned = turned_alike(Surface(vertices_mm=vertices, faces=mixed))
    np.testing.assert_array_equal(turned, wrong)
    np.testing.assert_array_equal(mended.faces, faces)


def test_single_triangles_know_their_neighbours_by_place():
    bone = made_bone(fine=3)
    soup = Surface(vertices_mm=bone.corners_mm.reshape(-1, 3), faces=np.arange(3 * len(bone.faces)).reshape(-1, 3))
    faces = soup.faces.copy()
    faces[7] = faces[7, ::-1]
    mended, turned = turned_alike(Surface(vertices_mm=soup.vertices_mm, faces=faces))
    assert np.flatnonzero(turned).tolist() == [7]
    np.testing.assert_array_equal(mended.faces, soup.faces)
    assert len(joined(soup).vertices_mm) == len(np.unique(bone.vertices_mm, axis=0))
    np.testing.assert_allclose(joined(soup).volume_mm3, bone.volume_mm3)


def test_a_sound_mesh_stays_as_it_is():
    bone = made_bone(fine=3)
    same, turned = turned_alike(bone)
    assert not turned.any()
    np.testing.assert_array_equal(same.faces, bone.faces)
