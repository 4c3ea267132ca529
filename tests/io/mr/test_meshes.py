from pathlib import Path

import numpy as np
import pytest
import trimesh

from marey.errors import FileProblem
from marey.io.mr.meshes import read_mesh, write_mesh
from marey.io.npz import write_arrays
from marey.knee.space.surface import TriangleSurface


@pytest.fixture
def ball() -> TriangleSurface:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=20.0)
    return TriangleSurface(
        vertices_mm=np.asarray(mesh.vertices) * (1, 1.5, 0.7) + (-60, 5, 30), faces=np.asarray(mesh.faces)
    )


@pytest.mark.parametrize(("ending", "exact"), [("ply", 0.0), ("vtk", 0.0), ("glb", 1e-5), ("npz", 0.0)])
def test_a_written_mesh_is_read_with_vertices_in_order(
    ending: str, exact: float, ball: TriangleSurface, tmp_path: Path
):
    path = tmp_path / f"bone.{ending}"
    if ending == "npz":
        write_arrays(path, {"vertices": ball.vertices_mm, "faces": ball.faces})
    else:
        write_mesh(path, ball)
    back = read_mesh(path)
    np.testing.assert_allclose(back.vertices_mm, ball.vertices_mm, atol=exact)
    np.testing.assert_array_equal(back.faces, ball.faces)


def test_a_written_stl_is_read_as_one_closed_surface(ball: TriangleSurface, tmp_path: Path):
    write_mesh(tmp_path / "bone.stl", ball)
    back = read_mesh(tmp_path / "bone.stl")
    assert len(back.vertices_mm) == len(ball.vertices_mm)
    np.testing.assert_allclose(back.volume_mm3, ball.volume_mm3, rtol=1e-6)


def test_a_glb_is_upright_in_metres_and_not_mirrored(ball: TriangleSurface, tmp_path: Path):
    write_mesh(tmp_path / "bone.glb", ball)
    mesh = trimesh.load(tmp_path / "bone.glb", force="mesh")
    np.testing.assert_allclose(np.asarray(mesh.vertices).mean(0), (-0.060, 0.030, -0.005), atol=1e-6)
    np.testing.assert_allclose(mesh.volume, ball.volume_mm3 * 1e-9, rtol=1e-5)


def test_other_programs_read_colours_and_the_order_of_the_vertices(ball: TriangleSurface, tmp_path: Path):
    colours = np.arange(3 * len(ball.vertices_mm)).reshape(-1, 3).astype(np.uint8)
    write_mesh(tmp_path / "bone.ply", ball, colours=colours, values={"thickness_mm": ball.vertices_mm[:, 0]})
    mesh = trimesh.load(tmp_path / "bone.ply", process=False)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], colours)
    np.testing.assert_array_equal(mesh.vertices, ball.vertices_mm)
    write_mesh(tmp_path / "bone.vtk", ball, colours=colours, values={"thickness_mm": ball.vertices_mm[:, 0]})
    np.testing.assert_array_equal(read_mesh(tmp_path / "bone.vtk").vertices_mm, ball.vertices_mm)


def test_a_mesh_that_is_inside_out_is_turned(ball: TriangleSurface, tmp_path: Path):
    write_mesh(tmp_path / "bone.ply", TriangleSurface(vertices_mm=ball.vertices_mm, faces=ball.faces[:, ::-1]))
    assert read_mesh(tmp_path / "bone.ply").volume_mm3 > 0


def test_vtk_written_as_text_by_version_5_is_read(tmp_path: Path):
    (tmp_path / "four.vtk").write_text(
        "# vtk DataFile Version 5.1\nfour\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n0 0 0 1 0 0 0 1 0 0 0 1\n"
        "METADATA\nINFORMATION 0\n\nPOLYGONS 5 12\nOFFSETS vtktypeint64\n0 3 6 9 12\n"
        "CONNECTIVITY vtktypeint64\n0 2 1 0 1 3 0 3 2 1 2 3\n"
    )
    np.testing.assert_allclose(read_mesh(tmp_path / "four.vtk").volume_mm3, 1 / 6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bone.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "bone.ply"),
        ("bone.ply", b"", "bone.ply"),
        ("bone.stl", b"not a mesh", "bone.stl"),
        ("bone.vtk", b"# vtk DataFile Version 3.0\n\nASCII\nDATASET UNSTRUCTURED_GRID\n", "POLYDATA"),
        # A negative count would lead back to the same words without an end.
        (
            "bone.vtk",
            b"# vtk DataFile Version 3.0\n\nBINARY\nDATASET POLYDATA\nPOINTS -2 double\n",
            "states -6 numbers",
        ),
        (
            "bone.vtk",
            b"# vtk DataFile Version 3.0\n\nBINARY\nDATASET POLYDATA\nPOINTS 1" + b"0" * 30 + b" double\n",
            "numbers",
        ),
        ("bone.vtk", b"", "is empty"),
        ("bone.vtk", b"nothing", "VTK"),
        ("bone.txt", b"1 2 3", "unknown mesh format"),
    ],
)
def test_a_damaged_file_is_named(name: str, content: bytes, message: str, tmp_path: Path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileProblem, match=message):
        read_mesh(tmp_path / name)


def test_a_missing_file_and_faces_without_vertices_are_rejected(tmp_path: Path, ball: TriangleSurface):
    with pytest.raises(FileProblem, match="does not exist"):
        read_mesh(tmp_path / "none.ply")
    write_arrays(tmp_path / "bone.npz", {"vertices": ball.vertices_mm[:5], "faces": ball.faces})
    with pytest.raises(FileProblem, match="vertices that do not exist"):
        read_mesh(tmp_path / "bone.npz")
    with pytest.raises(FileProblem, match="formats for writing"):
        write_mesh(tmp_path / "bone.txt", ball)
