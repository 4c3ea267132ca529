"""The thickness of cartilage on meshes: files, repairs, and errors."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from tests.verdicts import agreed_verdict

from marey.errors import FileProblem
from marey.io.mr.meshes import read_mesh, write_mesh
from marey.io.npz import read_arrays
from marey.knee.space.surface import TriangleSurface
from marey.pipelines.knee.meshes import read_bone
from marey.pipelines.knee.thickness import measure_thickness
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import Verdict


def ball(radius: float) -> TriangleSurface:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return TriangleSurface(vertices_mm=mesh.vertices, faces=mesh.faces)


def shell(inner: float, outer: float) -> TriangleSurface:
    """A hollow ball."""
    within, without = ball(inner), ball(outer)
    count = len(within.vertices_mm)
    return TriangleSurface(
        vertices_mm=np.concatenate([within.vertices_mm, without.vertices_mm]),
        faces=np.concatenate([within.faces[:, ::-1], without.faces + count]),
    )


def test_thickness_writes_one_number_per_vertex_and_a_coloured_bone(tmp_path: Path):
    write_mesh(tmp_path / "bone.ply", ball(20.0))
    write_mesh(tmp_path / "cartilage.ply", shell(20.0, 22.0))
    measured = measure_thickness(tmp_path / "bone.ply", tmp_path / "cartilage.ply")
    out = measured.save(tmp_path / "out")
    np.testing.assert_allclose(read_arrays(out / "thickness.npz")["thickness_mm"], 2.0, atol=0.02)
    assert len(read_mesh(out / "thickness.ply").vertices_mm) == len(ball(20.0).vertices_mm)
    assert "mean 2.0" in str(measured.summary())
    assert agreed_verdict(out / "run.json") == measured.verdict == Verdict()


def test_a_thickness_at_a_flat_end_of_the_bone_is_marked(tmp_path: Path):
    """A ball in its shell, both cut off flat: over the cut, the lines along its normal still meet the cartilage."""
    bone, sheet = ball(20.0), shell(20.0, 22.0)

    def cut(surface: TriangleSurface) -> TriangleSurface:
        return TriangleSurface(vertices_mm=np.minimum(surface.vertices_mm, [np.inf, np.inf, 15.0]), faces=surface.faces)

    write_mesh(tmp_path / "bone.ply", cut(bone))
    write_mesh(tmp_path / "cartilage.ply", sheet)
    measured = measure_thickness(tmp_path / "bone.ply", tmp_path / "cartilage.ply")
    flat = measured.surface.vertices_mm[:, 2] > 15.0 - 1e-6
    assert measured.cut[flat].all()
    assert measured.verdict.level == "usable with limits"
    assert "flat end of the bone" in str(measured.verdict)
    assert "mean 2.0" in str(measured.summary())
    saved = read_arrays(measured.save(tmp_path / "out") / "thickness.npz")
    np.testing.assert_array_equal(saved["at_cut"], measured.cut)


def test_cartilage_of_another_bone_is_an_error(tmp_path: Path):
    write_mesh(tmp_path / "bone.ply", ball(20.0))
    write_mesh(tmp_path / "cartilage.ply", shell(40.0, 42.0))
    with pytest.raises(FileProblem, match="does not lie on the bone"):
        measure_thickness(tmp_path / "bone.ply", tmp_path / "cartilage.ply")


def test_cartilage_that_mostly_lies_elsewhere_is_an_error_and_names_its_file(tmp_path: Path):
    """Moved by its bone's radius, or half as large, some lines still go through it: that is no thickness."""
    bone, good = ball(20.0), shell(20.0, 22.0)
    faces = good.faces
    write_mesh(tmp_path / "bone.ply", bone)
    write_mesh(tmp_path / "good.ply", good)
    write_mesh(tmp_path / "moved.ply", TriangleSurface(vertices_mm=good.vertices_mm + [20.0, 0, 0], faces=faces))
    write_mesh(tmp_path / "half.ply", TriangleSurface(vertices_mm=good.vertices_mm / 2 + [10.0, 0, 0], faces=faces))
    for name in ("moved", "half"):
        with pytest.raises(FileProblem, match=rf"{name}\.ply: is not on that bone: only"):
            measure_thickness(tmp_path / "bone.ply", [tmp_path / "good.ply", tmp_path / f"{name}.ply"])


def test_cartilage_that_partly_lies_beside_the_bone_is_measured_with_a_note(tmp_path: Path):
    bone = ball(20.0)
    write_mesh(
        tmp_path / "bone.ply",
        TriangleSurface(vertices_mm=bone.vertices_mm, faces=bone.faces[bone.corners_mm[..., 2].max(1) < 6]),
    )
    write_mesh(tmp_path / "cartilage.ply", shell(20.0, 22.0))
    progress = RecordingProgress()
    verdict = measure_thickness(tmp_path / "bone.ply", tmp_path / "cartilage.ply", progress=progress).verdict
    (warning,) = progress.warnings
    assert verdict.texts() == ("usable with limits", [warning])
    assert "of its volume is over the bone bone.ply; the rest is not measured." in warning


def test_small_holes_and_reversed_faces_are_repaired_and_an_open_sheet_is_an_error(tmp_path: Path):
    bone, sheet = ball(20.0), shell(20.0, 22.0)
    faces = sheet.faces.copy()
    faces[5:9] = faces[5:9, ::-1]
    write_mesh(tmp_path / "bone.ply", bone)
    write_mesh(
        tmp_path / "cartilage.ply", TriangleSurface(vertices_mm=sheet.vertices_mm, faces=np.delete(faces, 1500, 0))
    )
    progress = RecordingProgress()
    measured = measure_thickness(tmp_path / "bone.ply", tmp_path / "cartilage.ply", progress=progress)
    text = " ".join(progress.warnings)
    assert "4 of" in text
    assert "1 small hole was closed" in text
    np.testing.assert_allclose(measured.thickness_mm, 2.0, atol=0.05)
    half = ball(22.0)
    below = half.corners_mm[..., 2].max(1) < 0
    write_mesh(tmp_path / "open.ply", TriangleSurface(vertices_mm=half.vertices_mm, faces=half.faces[below]))
    with pytest.raises(FileProblem, match="is open"):
        measure_thickness(tmp_path / "bone.ply", tmp_path / "open.ply")


def test_a_missing_mesh_is_named(tmp_path: Path):
    with pytest.raises(FileProblem, match=r"bone\.ply"):
        measure_thickness(tmp_path / "bone.ply", tmp_path / "cartilage.ply")


def test_a_bone_given_as_cartilage_is_reported(tmp_path: Path):
    write_mesh(tmp_path / "bone.ply", ball(11.0))
    near, far = ball(5.0), ball(20.0)
    both = np.concatenate([near.vertices_mm + [0, 0, 15.0], far.vertices_mm + [0, 0, 100.0]])
    faces = np.concatenate([near.faces, far.faces + len(near.vertices_mm)])
    write_mesh(tmp_path / "large.ply", TriangleSurface(vertices_mm=both, faces=faces))
    wrong = r"large\.ply: is too large for the cartilage of that bone: its volume is 33\."
    with pytest.raises(FileProblem, match=wrong):
        measure_thickness(tmp_path / "bone.ply", tmp_path / "large.ply")


def test_a_flat_and_an_empty_mesh_are_reported(tmp_path: Path):
    corners = np.array([[0.0, 0, 0], [50, 0, 0], [0, 50, 0], [50, 50, 0]])
    write_mesh(tmp_path / "flat.ply", TriangleSurface(vertices_mm=corners, faces=np.array([[0, 1, 2], [2, 1, 3]])))
    (tmp_path / "empty.ply").touch()
    for name, text in (("flat", "is flat: 2 faces in one plane"), ("empty", "is empty")):
        with pytest.raises(FileProblem, match=rf"{name}\.ply: {text}"):
            read_bone(tmp_path / f"{name}.ply", RecordingProgress())
