import numpy as np
import pytest
import trimesh
from tests.made_joints import RADIUS_MM, made_joint

from marey.errors import MareyError
from marey.knee.motion.joint_surface import JointSurface, _feature, joint_surface, whole_surface
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import corner_weights


@pytest.fixture(scope="module")
def joint() -> dict[str, TriangleSurface]:
    return made_joint()


def box(size: float = 20.0) -> JointSurface:
    mesh = trimesh.creation.box((size,) * 3).subdivide().subdivide()
    return whole_surface("femur", TriangleSurface(vertices_mm=mesh.vertices, faces=mesh.faces), left=None)


def test_the_joint_side_of_a_plate_is_its_upper_side(joint):
    upper = joint_surface("tibial_cartilage", joint["tibial_cartilage"], joint["tibia"], left=False)
    assert upper.surface.area_mm2 == pytest.approx(2 * 34 * 40)
    np.testing.assert_allclose(upper.surface.vertices_mm[:, 2], 0, atol=1e-12)
    np.testing.assert_array_equal(
        joint["tibial_cartilage"].vertices_mm[upper.sources], upper.surface.vertices_mm
    )  # fmt: skip
    assert upper.surface.vertex_areas_mm2.sum() == pytest.approx(2 * 34 * 40)


def test_the_joint_side_of_a_shell_is_its_outer_one(joint):
    outer = joint_surface("femoral_cartilage", joint["femoral_cartilage"], joint["femur"], left=False)
    middles = np.array([[22.0, 0, RADIUS_MM + 1], [-22.0, 0, RADIUS_MM + 1]])
    away = np.linalg.norm(outer.surface.vertices_mm[:, None] - middles, axis=2).min(1)
    # At the rim, in the corner between condyle and shaft, a face or two of the walls may look away from the bone.
    assert (np.abs(away - RADIUS_MM) < 1e-9).mean() > 0.998


def test_lateral_is_away_from_the_other_leg(joint):
    right = joint_surface("tibial_cartilage", joint["tibial_cartilage"], joint["tibia"], left=False)
    left = joint_surface("tibial_cartilage", joint["tibial_cartilage"], joint["tibia"], left=True)
    np.testing.assert_array_equal(right.lateral, right.surface.vertices_mm[:, 0] < 0)
    np.testing.assert_array_equal(left.lateral, ~right.lateral)
    assert whole_surface("tibia", joint["tibia"], left=None).lateral is None


def test_where_one_plateau_is_bare_the_other_keeps_its_name(joint):
    plates = joint["tibial_cartilage"]
    medial = plates.faces[(plates.corners_mm[..., 0] > 0).all(1)]
    alone = TriangleSurface(vertices_mm=plates.vertices_mm, faces=medial)
    upper = joint_surface("tibial_cartilage", alone, joint["tibia"], left=False)
    assert not upper.lateral.any()


def test_heights_over_a_box_have_the_right_sign_at_faces_edges_and_corners(rng):
    points = rng.uniform(-18, 18, (600, 3))
    found = box().heights(points)
    out = np.maximum(np.abs(points) - 10, 0)
    within = np.minimum((np.abs(points) - 10).max(1), 0)
    np.testing.assert_allclose(found.distance_mm, np.linalg.norm(out, axis=1) + within, atol=1e-9)


def test_the_upward_direction_is_the_distance_s_slope(rng):
    surface, points = box(), rng.uniform(-16, 16, (200, 3))
    found = surface.heights(points)
    np.testing.assert_allclose(np.linalg.norm(found.upward, axis=1), 1, atol=1e-9)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (surface.heights(points + step).distance_mm - surface.heights(points - step).distance_mm) / 2e-6
        kinked = np.abs(slope - found.upward[:, axis]) > 1e-4  # on the box' planes of symmetry there is no slope
        assert kinked.mean() < 0.02


def test_beside_and_below_a_rim_there_is_no_distance():
    plate = trimesh.Trimesh([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], [[0, 1, 2], [0, 2, 3]])
    surface = whole_surface("tibia", TriangleSurface(vertices_mm=plate.vertices, faces=plate.faces), left=None)
    points = np.array([[5.0, 5, 2], [5, 5, -2], [13, 5, 4], [13, 5, -4], [-3, -4, 0], [5, 5, 0]])
    np.testing.assert_allclose(surface.heights(points).distance_mm, [2, -2, 5, np.nan, 5, 0])
    np.testing.assert_allclose(surface.heights(points).upward[[1, 5]], [[0, 0, 1], [0, 0, 1]])


def test_a_guess_changes_nothing(rng):
    surface, points = box(), rng.uniform(-18, 18, (300, 3))
    plain = surface.heights(points)
    guess = rng.integers(0, len(surface.surface.faces), 300)
    np.testing.assert_allclose(surface.heights(points, guess).distance_mm, plain.distance_mm, atol=1e-12)


def test_the_part_of_a_triangle_is_that_of_the_plain_formula(rng):
    corners = rng.normal(0, 5, (60, 3, 3))
    shares = rng.dirichlet((1, 1, 1), 60)
    shares[:20, 0] = 0
    shares[10:30, 2] = 0
    shares /= shares.sum(1, keepdims=True)
    places = np.einsum("nc,nci->ni", shares, corners)
    there = corner_weights(corners, places) > 1e-7
    count = there.sum(-1)
    wanted = np.select([count == 3, count == 2], [0, 1 + np.argmin(there, -1)], 4 + np.argmax(there, -1))
    assert set(wanted) == {0, 1, 3, 5}
    np.testing.assert_array_equal([_feature(c, p) for c, p in zip(corners, places, strict=True)], wanted)


def test_cartilage_turned_inside_out_has_no_joint_side(joint):
    plates, tibia = joint["tibial_cartilage"], joint["tibia"]
    turned = TriangleSurface(vertices_mm=tibia.vertices_mm, faces=tibia.faces[:, ::-1])
    far = TriangleSurface(vertices_mm=plates.vertices_mm * (1, 1, 0.0), faces=plates.faces[:0])
    with pytest.raises(MareyError, match="no side"):
        joint_surface("tibial_cartilage", far, turned, left=None)
