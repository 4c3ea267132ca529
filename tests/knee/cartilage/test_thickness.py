import numpy as np
import pytest
import trimesh

from marey.errors import MareyError
from marey.io.mr.meshes import read_mesh
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.space.surface import TriangleSurface


def shell(inner: float, outer: float, *, above: float) -> TriangleSurface:
    """The part of a spherical shell with z above a height, closed at its rim."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    up = ball.vertices[:, 2] > above
    faces = ball.faces[up[ball.faces].all(1)]
    mesh = trimesh.Trimesh(ball.vertices, faces, process=True)
    rim = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    n = len(mesh.vertices)
    sides = np.concatenate([np.c_[rim[:, 0], rim[:, 1], rim[:, 1] + n], np.c_[rim[:, 0], rim[:, 1] + n, rim[:, 0] + n]])
    vertices = np.concatenate([inner * mesh.vertices, outer * mesh.vertices])
    return TriangleSurface(vertices_mm=vertices, faces=np.concatenate([mesh.faces[:, ::-1], mesh.faces + n, sides]))


@pytest.fixture
def bone() -> TriangleSurface:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    return TriangleSurface(vertices_mm=ball.vertices, faces=ball.faces)


@pytest.mark.parametrize("gap", [0.0, -0.3, 0.4])
def test_a_cap_on_a_ball_has_its_thickness_and_the_rest_is_bare(bone: TriangleSurface, gap: float):
    cap = shell(20.0 + gap, 22.5 + gap, above=0.5)
    thickness = cartilage_thickness(bone, [cap])
    height = bone.vertices_mm[:, 2] / 20
    # A facet lies below the sphere by the edge's square over eight radii; the rim is ragged by an edge, 0.08.
    np.testing.assert_allclose(thickness[height > 0.62], 2.5, atol=0.02)
    assert (thickness[height < 0.45] == 0).all()


def test_two_cartilages_are_measured_together(bone: TriangleSurface):
    above = shell(20.0, 22.0, above=0.6)
    below = TriangleSurface(vertices_mm=-shell(20.0, 21.0, above=0.6).vertices_mm, faces=above.faces[:, ::-1])
    thickness = cartilage_thickness(bone, [above, below])
    height = bone.vertices_mm[:, 2] / 20
    np.testing.assert_allclose(thickness[height > 0.72], 2.0, atol=0.02)
    np.testing.assert_allclose(thickness[height < -0.72], 1.0, atol=0.02)


def test_cartilage_of_the_bone_across_the_joint_is_not_counted(bone: TriangleSurface):
    assert not cartilage_thickness(bone, [shell(20.0, 21.0, above=0.9), shell(23.0, 25.0, above=0.0)])[
        (bone.vertices_mm[:, 2] > 2) & (bone.vertices_mm[:, 2] < 16)
    ].any()


def test_cartilage_far_from_the_bone_is_an_error(bone: TriangleSurface):
    far = TriangleSurface(
        vertices_mm=shell(20, 22, above=0.5).vertices_mm + (0, 0, 50), faces=shell(20, 22, above=0.5).faces
    )
    with pytest.raises(MareyError, match="does not lie on the bone"):
        cartilage_thickness(bone, [far])


@pytest.mark.parametrize(
    ("bone_name", "cartilages"),
    [("femur", ("femoral_cartilage",)), ("tibia", ("medial_tibial_cartilage", "lateral_tibial_cartilage"))],
)
def test_real_meshes_have_the_thickness_that_was_stored_with_them(shared, bone_name, cartilages):
    folder = shared / "data" / "knee" / "thickness"
    ours = cartilage_thickness(
        read_mesh(folder / f"{bone_name}.npz"), [read_mesh(folder / f"{name}.npz") for name in cartilages]
    )
    with np.load(folder / f"{bone_name}.npz") as file:
        true = file["thickness_mm"]
    covered = true > 0.01
    both = covered & (ours > 0.01)
    assert np.abs(ours - true)[both].mean() <= 0.1
    assert (ours > 0.01)[covered].mean() >= 0.97
    assert (ours > 0.01)[~covered].mean() <= 0.02
