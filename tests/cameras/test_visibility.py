"""What a camera sees of meshes whose image is known."""

import numpy as np
import pytest
import trimesh

from marey.cameras.visibility import View, outline_pixels, see


def project(vertices, focal=500.0, centre=(160.0, 120.0)):
    z = vertices[:, 2]
    return np.stack([focal * vertices[:, 0] / z + centre[0], focal * vertices[:, 1] / z + centre[1], 1 / z], 1)


def outward(mesh):
    # In camera axes (y down) a face seen from outside runs clockwise in mathematical axes, as in the world.
    return np.array(mesh.vertices), np.array(mesh.faces)


def test_a_square_covers_the_pixels_whose_centres_lie_in_it():
    corners = np.array([[9.5, 19.5, 1.0], [49.5, 19.5, 1.0], [49.5, 39.5, 1.0], [9.5, 39.5, 1.0]])
    view = see(corners, np.array([[0, 2, 1], [0, 3, 2]]), (100, 80))
    expected = np.zeros((80, 100), bool)
    expected[20:40, 10:50] = True
    np.testing.assert_array_equal(view.mask(), expected)


def test_a_back_face_is_not_seen():
    corners = np.array([[10.0, 10, 1], [40, 10, 1], [10, 40, 1]])
    assert see(corners, np.array([[0, 2, 1]]), (60, 60)).mask().any()
    assert not see(corners, np.array([[0, 1, 2]]), (60, 60)).mask().any()


def test_the_nearer_surface_hides_the_farther():
    near = np.array([[10.0, 10, 1 / 2], [40, 10, 1 / 2], [10, 40, 1 / 2]])
    far = near * [1, 1, 0.5]
    faces = np.array([[0, 2, 1], [3, 5, 4]])
    for order in (faces, faces[::-1]):
        view = see(np.concatenate([near, far]), order, (60, 60))
        assert set(np.unique(order[view.face[view.covered]][:, 0])) == {0}


def test_the_rim_of_a_sphere_is_seen_where_its_outline_is():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    vertices, faces = outward(sphere)
    vertices = vertices + np.array([0.1, -0.05, 3.0])
    view = see(project(vertices), faces, (320, 240))
    rim = view.rim(faces)
    points = np.einsum("nc,nca->na", rim.barycentric, vertices[faces[rim.face]])
    # The point lies where its pixel looks, at the depth in the buffer.
    seen = project(points)
    np.testing.assert_allclose(seen[:, :2], rim.pixels, atol=1e-6)
    np.testing.assert_allclose(points[:, 2], rim.depth, atol=1e-9)
    # The line of sight touches the sphere there to within a pixel.
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    centre = np.array([0.1, -0.05, 3.0])
    distance = np.linalg.norm(centre - (ray @ centre)[:, None] * ray, axis=1)
    assert np.abs(distance - 0.3).max() < 1.5 * 3.0 / 500
    towards = project(centre[None])[0, :2] - rim.pixels
    assert ((towards / np.linalg.norm(towards, axis=1, keepdims=True)) * rim.inward).sum(1).min() > 0.9


def test_a_person_cut_by_the_border_has_no_rim_there():
    corners = np.array([[-20.0, -20, 1.0], [30.2, -20, 1.0], [30.2, 200, 1.0], [-20, 200, 1.0]])
    view = see(corners, np.array([[0, 2, 1], [0, 3, 2]]), (100, 80))
    rim = view.rim(np.array([[0, 2, 1], [0, 3, 2]]))
    assert set(rim.pixels[:, 0]) == {30}


def blobs(rng, shape):
    """Random squares and single pixels, in a buffer of faces."""
    covered = rng.random(shape) < 0.02
    for y, x in rng.integers(0, shape, (12, 2)):
        covered[y : y + 6, x : x + 6] = True
    return np.where(covered, 0, -1).astype(np.int32)


def rim_of(face):
    """The rim's pixels x, y and their normals, from what is covered near each."""
    covered = face >= 0
    inside = np.pad(covered, 1, constant_values=True)
    all_beside = inside[:-2, 1:-1] & inside[2:, 1:-1] & inside[1:-1, :-2] & inside[1:-1, 2:]
    within = np.pad(np.ones((face.shape[0] - 2, face.shape[1] - 2), bool), 1)
    y, x = np.nonzero(covered & ~all_beside & within)
    rows, columns = np.indices(face.shape)
    near = (np.abs(rows - y[:, None, None]) <= 2) & (np.abs(columns - x[:, None, None]) <= 2) & covered
    across, down = columns - x[:, None, None], rows - y[:, None, None]
    towards = np.stack([(near * across).sum((1, 2)), (near * down).sum((1, 2))], 1)
    return np.stack([x, y], 1), towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)


@pytest.mark.parametrize("shape", [(40, 37), (33, 40), (9, 5), (3, 3), (2, 2)])
def test_the_rim_is_what_is_covered_beside_something_uncovered_and_points_to_what_is_covered(rng, shape):
    face = blobs(rng, shape)
    triangle = np.array([[-500.0, -500, 1], [500, -500, 1], [-500, 500, 1]])
    pixels, inward = rim_of(face)
    view = View((7, 11), (60, 60), np.zeros(shape), face, triangle)
    rim = view.rim(np.array([[0, 2, 1]]))
    np.testing.assert_array_equal(rim.pixels, pixels + [7, 11])
    np.testing.assert_allclose(rim.inward, inward, atol=1e-12)
    x, y = (pixels + [7, 11]).T
    kept = inward.any(1) & (x >= 10) & (x < 50) & (y >= 10) & (y < 50)
    np.testing.assert_array_equal(outline_pixels(face, 7, 11, 60, 60, 10), (pixels + [7, 11])[kept])


def test_a_mesh_behind_the_camera_is_not_seen():
    assert not see(np.full((3, 3), np.nan), np.array([[0, 2, 1]]), (60, 60)).mask().any()


def test_what_reaches_behind_the_camera_is_seen_as_far_as_it_lies_before_it():
    corners = np.array([[10.0, 10, 1], [40, 10, 1], [10, 40, 1], [np.nan, np.nan, 0.0]])
    faces = np.array([[0, 2, 1], [1, 2, 3]])
    whole = see(corners, faces, (60, 60))
    np.testing.assert_array_equal(whole.mask(), see(corners[:3], faces[:1], (60, 60)).mask())
    behind = np.tile([np.nan, np.nan, 0.0], (4, 1))
    assert not see(behind, faces, (60, 60)).mask().any()
    assert len(see(behind, faces, (60, 60)).rim(faces).face) == 0


def two_spheres(gap):
    """A small sphere before a large one, by a gap between the small one's centre and the large one's near point."""
    small, faces = outward(trimesh.creation.icosphere(subdivisions=4, radius=0.1))
    large, others = outward(trimesh.creation.icosphere(subdivisions=4, radius=0.4))
    centre = np.array([0.02, -0.03, 2.6 - gap])
    vertices = np.concatenate([small + centre, large + [0, 0, 3.0]])
    limb = np.repeat([1, 0], [len(faces), len(others)])
    return vertices, np.concatenate([faces, others + len(small)]), limb, centre


def test_what_stands_before_another_limb_has_its_rim_inside_of_the_outline():
    vertices, faces, limb, centre = two_spheres(0.3)
    view = see(project(vertices), faces, (320, 240))
    rim = view.interior_rim(faces, limb)
    assert set(limb[rim.face]) == {1}
    points = np.einsum("nc,nca->na", rim.barycentric, vertices[faces[rim.face]])
    np.testing.assert_allclose(project(points)[:, :2], rim.pixels, atol=1e-6)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    distance = np.linalg.norm(centre - (ray @ centre)[:, None] * ray, axis=1)
    assert np.abs(distance - 0.1).max() < 1.5 * centre[2] / 500
    towards = project(centre[None])[0, :2] - rim.pixels
    assert ((towards / np.linalg.norm(towards, axis=1, keepdims=True)) * rim.inward).sum(1).min() > 0.9
    # All round: the small sphere's outline has about as many pixels as its rim alone.
    alone = see(project(vertices), faces[limb == 1], (320, 240)).rim(faces[limb == 1])
    assert len(rim.face) == len(alone.face)


def test_limbs_that_touch_or_are_one_show_no_rim_between_them():
    vertices, faces, limb, _ = two_spheres(0.3)
    view = see(project(vertices), faces, (320, 240))
    assert len(view.interior_rim(faces, 0 * limb).face) == 0
    # The rim of the small sphere lies 0.33 before the large one; with a larger threshold none is found.
    assert len(view.interior_rim(faces, limb, jump=0.5).face) == 0
    vertices, faces, limb, _ = two_spheres(-0.05)
    sunk = see(project(vertices), faces, (320, 240))
    assert len(sunk.interior_rim(faces, limb).face) == 0
