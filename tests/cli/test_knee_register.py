import json
from pathlib import Path

import numpy as np
import pytest
from tests.made_bones import made_bone

from marey.cli.main import run
from marey.geometry.rigid import RigidTransform
from marey.io.mr.meshes import read_mesh, write_mesh
from marey.io.mr.tables import read_rigid
from marey.knee.space.sides import MIRROR, mirrored
from marey.knee.space.surface import TriangleSurface


@pytest.mark.slow
def test_a_bone_of_the_other_side_is_registered(tmp_path: Path, capsys):
    bone = made_bone(shaft_mm=30.0, size=0.55, fine=3)
    motion = RigidTransform.from_vector(np.radians([10.0, -5, 20]), np.array([20.0, -10, 5]))
    write_mesh(tmp_path / "template.ply", mirrored(bone))
    write_mesh(tmp_path / "femur.ply", TriangleSurface(vertices_mm=motion.apply(bone.vertices_mm), faces=bone.faces))
    assert run(["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "femur.ply")]) == 0
    assert "other side" in capsys.readouterr().err
    out = tmp_path / "femur_marey"
    np.testing.assert_allclose(read_rigid(out / "rigid.json"), motion.matrix @ MIRROR, atol=1e-3)
    np.testing.assert_allclose(read_mesh(out / "registered.ply").vertices_mm, motion.apply(bone.vertices_mm), atol=0.05)
    about = json.loads((out / "rigid.json").read_text(encoding="utf-8"))
    assert about["least_jacobian_determinant"] > 0
    assert about["mirrored"]
    assert about["side_clear"]
    assert len(about["sd_mm"]) == len(about["sd_deg"]) == 3


@pytest.mark.slow
def test_typical_faults_of_meshes_are_repaired_and_reported(tmp_path: Path, capsys):
    bone = made_bone(shaft_mm=30.0, size=0.55, fine=3)
    write_mesh(tmp_path / "femur.stl", bone)
    faces = bone.faces.copy()
    faces[:40] = faces[:40, ::-1]
    # Single triangles, some of them inside out, in the order of their corners.
    soup = TriangleSurface(
        vertices_mm=bone.vertices_mm[faces].reshape(-1, 3), faces=np.arange(faces.size).reshape(-1, 3)
    )
    write_mesh(tmp_path / "template.ply", soup)
    arguments = ["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "femur.stl"), "--no-mirror"]
    assert run(arguments) == 0
    assert "40 of" in capsys.readouterr().err
    registered = read_mesh(tmp_path / "femur_marey" / "registered.ply").vertices_mm
    np.testing.assert_allclose(registered, soup.vertices_mm, atol=0.1)


def test_a_mesh_in_metres_is_reported(tmp_path: Path, capsys):
    bone = made_bone(fine=3)
    write_mesh(tmp_path / "femur.ply", bone)
    write_mesh(tmp_path / "metres.ply", TriangleSurface(vertices_mm=bone.vertices_mm / 1000, faces=bone.faces))
    assert run(["knee", "register", str(tmp_path / "metres.ply"), str(tmp_path / "femur.ply"), "--quiet"]) == 2
    assert "Is it in metres?" in capsys.readouterr().err


@pytest.mark.slow
def test_bones_that_do_not_fit_leave_nothing(tmp_path: Path, capsys):
    bone = made_bone(fine=3)
    write_mesh(tmp_path / "template.ply", bone)
    write_mesh(tmp_path / "whale.ply", TriangleSurface(vertices_mm=6 * bone.vertices_mm, faces=bone.faces))
    assert run(["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "whale.ply"), "--quiet"]) == 2
    assert "does not fit whale.ply" in capsys.readouterr().err
    assert not (tmp_path / "whale_marey").exists()


def test_a_folder_that_cannot_be_written_is_reported_before_the_work(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr(
        "marey.pipelines.knee.register.register_on_either_side", lambda *_, **__: pytest.fail("too late")
    )
    for name in ("template", "femur"):
        write_mesh(tmp_path / f"{name}.ply", made_bone(fine=3))
    words = ["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "femur.ply"), "--out"]
    assert run([*words, str(tmp_path / "femur.ply" / "below")]) == 2
    assert "cannot be created (Not a directory)" in capsys.readouterr().err


@pytest.mark.slow
def test_a_template_of_which_the_subject_shows_a_part_is_registered_with_a_note(tmp_path: Path, capsys):
    bone = made_bone(shaft_mm=30.0, size=0.55, fine=3)
    write_mesh(tmp_path / "template.ply", bone)
    part = bone.faces[bone.corners_mm[..., 0].max(1) < np.median(bone.vertices_mm[:, 0]) + 3.0]
    write_mesh(tmp_path / "part.ply", TriangleSurface(vertices_mm=bone.vertices_mm, faces=part))
    words = ["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "part.ply"), "--no-mirror"]
    assert run(words) == 0
    assert "% of template.ply is still more than 3 mm from part.ply: this part has no counterpart" in (
        capsys.readouterr().err
    )
