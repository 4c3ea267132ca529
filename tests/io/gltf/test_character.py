"""Reading characters: skinned GLBs of other programs, and meshes with joint centres in a TOML."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from marey.errors import FileProblem
from marey.io.gltf.character import read_character


def write_mixamo_like(path: Path) -> None:
    """Write a triangle on three bones below a scaled armature; the weight of the finger belongs to the hand."""
    positions = np.array([[100.0, 0, 0], [200, 0, 0], [300, 0, 0]], "<f4")
    joints = np.array([[0, 0, 0, 0], [1, 2, 0, 0], [2, 0, 0, 0]], "u1")
    weights = np.array([[255, 0, 0, 0], [51, 204, 0, 0], [255, 0, 0, 0]], "u1")
    bind = np.tile(np.eye(4), (3, 1, 1))
    bind[:, :3, 3] = [[-100, 0, 0], [-200, 0, 0], [-300, 0, 0]]
    parts = [positions, joints, weights, np.swapaxes(bind, 1, 2).astype("<f4"), np.array([0, 1, 2], "<u2")]
    views, binary = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": part.nbytes})
        binary += part.tobytes() + b"\0" * (-part.nbytes % 4)
    kinds = [(5126, 3, "VEC3"), (5121, 3, "VEC4"), (5121, 3, "VEC4"), (5126, 3, "MAT4"), (5123, 3, "SCALAR")]
    accessors = [
        {"bufferView": i, "componentType": c, "count": n, "type": t} | ({"normalized": True} if i == 2 else {})
        for i, (c, n, t) in enumerate(kinds)
    ]
    primitive = {"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "indices": 4}
    names = ("mixamorig:LeftArm", "mixamorig:LeftForeArm", "mixamorig:LeftForeArmTwist")
    nodes = [
        {"name": "Armature", "scale": [0.01] * 3, "children": [1, 4]},
        {"name": names[0], "translation": [100, 0, 0], "children": [2]},
        {"name": names[1], "translation": [100, 0, 0], "children": [3]},
        {"name": names[2], "translation": [100, 0, 0]},
        {"name": "mesh", "mesh": 0, "skin": 0},
    ]
    text = json.dumps({
        "asset": {"version": "2.0"}, "nodes": nodes, "meshes": [{"primitives": [primitive]}],
        "skins": [{"joints": [1, 2, 3], "inverseBindMatrices": 3}], "bufferViews": views, "accessors": accessors,
        "buffers": [{"byteLength": len(binary)}], "scenes": [{"nodes": [0]}],
    }).encode()  # fmt: skip
    text += b" " * (-len(text) % 4)
    head = struct.pack("<IIIII", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<II", len(binary), 0x004E4942) + binary)


def test_a_scaled_character_is_read_in_metres(tmp_path):
    path = tmp_path / "character.glb"
    write_mixamo_like(path)
    character = read_character(path)
    np.testing.assert_allclose(character.vertices, [[1, 0, 0], [2, 0, 0], [3, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(character.joint_centres["left_forearm"], [2, 0, 0], atol=1e-6)
    assert character.node_names["left_upperarm"] == "mixamorig:LeftArm"
    np.testing.assert_allclose(character.weights["left_forearm"], [0, 1, 1], atol=1e-6)


def write_scan(folder: Path, joints: str, head: str = 'mesh = "scan.obj"\nunit = "mm"\nup = "y"\n') -> Path:
    trimesh.creation.box((200, 1000, 300)).export(folder / "scan.obj")
    path = folder / "scan.toml"
    path.write_text(f"{head}[joints]\n{joints}")
    return path


def test_a_scan_with_joint_centres_is_read_in_metres_with_z_up(tmp_path):
    character = read_character(write_scan(tmp_path, "left_knee = [100, 500, 20]\npelvis = [0, 1000, 0]\n"))
    np.testing.assert_allclose(character.joint_centres["left_shank"], [0.1, -0.02, 0.5])
    np.testing.assert_allclose(character.joint_centres["pelvis"], [0, 0, 1])
    np.testing.assert_allclose(np.ptp(character.vertices, axis=0), [0.2, 0.3, 1.0])
    assert character.weights is None
    assert len(character.vertices) == 8


@pytest.mark.parametrize(
    ("joints", "head", "wrong"),
    [
        ("left_nee = [0, 0, 0]\n", 'mesh = "scan.obj"\n', "left_nee"),
        ("left_knee = [0, 0]\n", 'mesh = "scan.obj"\n', "left_knee"),
        ("", 'mesh = "scan.obj"\ncolour = 3\n', "colour"),
        ("", 'mesh = "other.obj"\n', "other.obj"),
        ("", 'mesh = "scan.obj"\nunit = "inch"\n', "inch"),
        ("", "", "lacks `mesh`"),
        ("left_knee = [0, 0", 'mesh = "scan.obj"\n', "is not TOML"),
    ],
)
def test_an_invalid_scan_is_an_error_that_states_the_problem(tmp_path, joints: str, head: str, wrong: str):
    with pytest.raises(FileProblem, match=wrong):
        read_character(write_scan(tmp_path, joints, head))


def test_a_glb_without_skin_is_rejected(tmp_path):
    path = tmp_path / "box.glb"
    trimesh.creation.box((1, 1, 1)).export(path)
    with pytest.raises(FileProblem, match="no skinned mesh"):
        read_character(path)
    path.write_bytes(b"nothing at all, and long enough to be read")
    with pytest.raises(FileProblem, match="is not a GLB"):
        read_character(path)
