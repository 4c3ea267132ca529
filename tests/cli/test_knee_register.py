import json
from pathlib import Path

import numpy as np
from tests.made_bones import made_bone

from marey.cli.main import run
from marey.geometry.rigid import RigidTransform
from marey.io.meshes import read_mesh, write_mesh
from marey.io.registration import read_rigid
from marey.knee.sides import MIRROR, mirrored
from marey.knee.surface import Surface


def test_a_bone_of_the_other_side_is_registered(tmp_path: Path, capsys):
    bone = made_bone(shaft_mm=30.0, size=0.55, fine=3)
    motion = RigidTransform.from_vector(np.radians([10.0, -5, 20]), np.array([20.0, -10, 5]))
    write_mesh(tmp_path / "template.ply", mirrored(bone))
    write_mesh(tmp_path / "femur.ply", Surface(vertices_mm=motion.apply(bone.vertices_mm), faces=bone.faces))
    arguments = ["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "femur.ply"), "--mirror"]
    assert run([*arguments, "--quiet"]) == 0
    out = tmp_path / "femur_marey"
    np.testing.assert_allclose(read_rigid(out / "rigid.json"), motion.matrix @ MIRROR, atol=1e-3)
    np.testing.assert_allclose(read_mesh(out / "registered.ply").vertices_mm, motion.apply(bone.vertices_mm), atol=0.05)
    assert json.loads((out / "rigid.json").read_text())["least_jacobian_determinant"] > 0


def test_bones_that_do_not_fit_leave_nothing(tmp_path: Path, capsys):
    bone = made_bone(fine=3)
    write_mesh(tmp_path / "template.ply", bone)
    write_mesh(tmp_path / "whale.ply", Surface(vertices_mm=8 * bone.vertices_mm, faces=bone.faces))
    assert run(["knee", "register", str(tmp_path / "template.ply"), str(tmp_path / "whale.ply"), "--quiet"]) == 2
    assert "does not fit whale.ply" in capsys.readouterr().err
    assert not (tmp_path / "whale_marey").exists()
