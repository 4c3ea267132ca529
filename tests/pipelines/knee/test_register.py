"""The registration of a bone: files, repairs, and errors."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.made_bones import made_bone
from tests.verdicts import agreed_verdict

from marey.errors import FileProblem
from marey.geometry.rigid import RigidTransform
from marey.io.mr.meshes import read_mesh, write_mesh
from marey.knee.space.sides import MIRROR, mirrored
from marey.knee.space.surface import TriangleSurface
from marey.pipelines.knee.register import register_bone
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import NotUsable


@pytest.mark.slow
def test_a_bone_of_the_other_side_is_registered(tmp_path: Path):
    bone = made_bone(shaft_mm=30.0, size=0.55, fine=2)
    motion = RigidTransform.from_vector(np.radians([10.0, -5, 20]), np.array([20.0, -10, 5]))
    write_mesh(tmp_path / "template.ply", mirrored(bone))
    write_mesh(tmp_path / "femur.ply", TriangleSurface(vertices_mm=motion.apply(bone.vertices_mm), faces=bone.faces))
    registered = register_bone(tmp_path / "template.ply", tmp_path / "femur.ply")
    assert registered.sided.mirrored
    assert registered.verdict.level == "good"
    out = registered.save(tmp_path / "out")
    rigid = json.loads((out / "rigid.json").read_text(encoding="utf-8"))["subject_from_template"]
    np.testing.assert_allclose(rigid, motion.matrix @ MIRROR, atol=1e-3)
    np.testing.assert_allclose(read_mesh(out / "registered.ply").vertices_mm, motion.apply(bone.vertices_mm), atol=0.05)
    about = json.loads((out / "rigid.json").read_text(encoding="utf-8"))
    assert about["least_jacobian_determinant"] > 0
    assert about["mirrored"]
    assert about["side_clear"]
    assert len(about["sd_mm"]) == len(about["sd_deg"]) == 3


@pytest.mark.slow
def test_typical_faults_of_meshes_are_repaired_and_reported(tmp_path: Path):
    bone = made_bone(shaft_mm=30.0, size=0.55, fine=2)
    write_mesh(tmp_path / "femur.stl", bone)
    faces = bone.faces.copy()
    faces[:40] = faces[:40, ::-1]
    # Single triangles, some of them inside out, in the order of their corners.
    soup = TriangleSurface(
        vertices_mm=bone.vertices_mm[faces].reshape(-1, 3), faces=np.arange(faces.size).reshape(-1, 3)
    )
    write_mesh(tmp_path / "template.ply", soup)
    progress = RecordingProgress()
    registered = register_bone(tmp_path / "template.ply", tmp_path / "femur.stl", mirror=False, progress=progress)
    assert "40 of" in progress.warnings[0]
    np.testing.assert_allclose(registered.surface.vertices_mm, soup.vertices_mm, atol=0.1)


def test_a_mesh_in_metres_is_reported(tmp_path: Path):
    bone = made_bone(fine=2)
    write_mesh(tmp_path / "femur.ply", bone)
    write_mesh(tmp_path / "metres.ply", TriangleSurface(vertices_mm=bone.vertices_mm / 1000, faces=bone.faces))
    with pytest.raises(FileProblem, match=r"Is it in metres\?"):
        register_bone(tmp_path / "metres.ply", tmp_path / "femur.ply")


@pytest.mark.slow
def test_bones_that_do_not_fit_are_not_usable(tmp_path: Path):
    # With coarser meshes it depends on rounding whether a rigid fit is found.
    bone = made_bone(fine=3)
    write_mesh(tmp_path / "template.ply", bone)
    write_mesh(tmp_path / "whale.ply", TriangleSurface(vertices_mm=6 * bone.vertices_mm, faces=bone.faces))
    with pytest.raises(NotUsable, match=r"template\.ply does not fit whale\.ply: "):
        register_bone(tmp_path / "template.ply", tmp_path / "whale.ply")


@pytest.mark.slow
def test_a_template_of_which_the_subject_shows_a_part_is_registered_with_a_note(tmp_path: Path):
    bone = made_bone(shaft_mm=30.0, size=0.55, fine=2)
    write_mesh(tmp_path / "template.ply", bone)
    part = bone.faces[bone.corners_mm[..., 0].max(1) < np.median(bone.vertices_mm[:, 0]) + 3.0]
    write_mesh(tmp_path / "part.ply", TriangleSurface(vertices_mm=bone.vertices_mm, faces=part))
    progress = RecordingProgress()
    registered = register_bone(tmp_path / "template.ply", tmp_path / "part.ply", mirror=False, progress=progress)
    assert registered.verdict.level == "usable with limits"
    assert agreed_verdict(registered.save(tmp_path / "out") / "run.json") == registered.verdict
    text = " ".join(progress.warnings)
    assert "% of template.ply is still more than 3 mm from part.ply" in text
    assert "has no counterpart" in text
