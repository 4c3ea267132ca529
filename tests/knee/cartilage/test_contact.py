import numpy as np
import trimesh

from marey.knee.cartilage.contact import contact_with
from marey.knee.space.surface import TriangleSurface


def plate(height: float) -> TriangleSurface:
    mesh = trimesh.creation.box((20, 20, 4))
    mesh.apply_translation((0, 0, height + 2))
    return TriangleSurface(vertices_mm=mesh.vertices, faces=mesh.faces)


def thickness_of(bone: TriangleSurface, thickness: float) -> np.ndarray:
    return np.full(len(bone.vertices_mm), thickness)


def test_the_ray_meets_the_nearest_bone_across_and_its_cartilage_begins_before_it():
    near, far = plate(5.0), plate(9.0)
    places = np.array([[0.0, 0, 0], [1, 2, 0], [30, 0, 0]])
    up = np.tile([0.0, 0, 1], (3, 1))
    contact = contact_with(places, up, [(far, thickness_of(far, 3.0)), (near, thickness_of(near, 1.5))])
    np.testing.assert_allclose(contact.away_mm, [5.0, 5.0, np.inf])
    np.testing.assert_allclose(contact.begins_mm, [3.5, 3.5, np.inf])
    np.testing.assert_allclose(contact.begins_sd_mm[:2], 0.5)
    # Both cartilages fill 5 mm in the ratio of 2.5 to 1.5 mm.
    np.testing.assert_allclose(contact.divided_mm(np.full(3, 2.5)), [3.125, 3.125, np.nan])
    assert contact.theirs[0, 0] < 1e-6
    assert contact.theirs[0, -1] > 0.999
    assert not contact.theirs[2].any()
    costs = contact.costs(np.array([0.0, 4.0, 6.0]))
    np.testing.assert_array_equal(costs > 0, [[False, False, True], [False, False, True], [False, False, False]])


def test_a_bare_bone_across_is_in_the_way_but_has_nothing_to_share():
    bare = plate(5.0)
    contact = contact_with(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), [(bare, thickness_of(bare, 0.0))])
    assert contact.away_mm[0] == 5.0
    assert np.isinf(contact.begins_mm[0])
