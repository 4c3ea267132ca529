from pathlib import Path

import numpy as np
import pytest
from tests.made_joints import made_joint

from marey.geometry import rotations
from marey.io.gltf.gltf import Gltf
from marey.io.mr.knee_glb import ColouredPart, write_knee_glb
from marey.markers.kinematics.transform_chain import NamedTransform

TIME = np.array([2.0, 2.1, 2.2])


@pytest.fixture
def gltf(tmp_path: Path, rng) -> tuple[Gltf, NamedTransform]:
    parts = made_joint(fine=2)
    turn, place = rotations.exp(rng.normal(0, 0.3, (3, 3))), rng.normal(0, 10, (3, 3))
    turn[1] = np.nan
    pose = NamedTransform(to="b", from_="a", rotation=turn, translation=place)
    coloured = {
        name: ColouredPart(
            bone="femur", surface=parts[name], see_through=name == "femur",
            colours=np.full((len(parts[name].vertices_mm), 3), (255, 128, 0), np.uint8),
        )
        for name in ("femur", "femoral_cartilage")
    }  # fmt: skip
    centre = np.array([[1.0, 2, 3], [np.nan] * 3, [4, 5, 6]])
    write_knee_glb(tmp_path / "knee.glb", coloured, {"femur": pose}, TIME, balls={"centre": ("femur", centre)})
    return Gltf(tmp_path / "knee.glb"), pose


def tracks(gltf: Gltf, name: str) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
    animation, found = gltf.document["animations"][0], {}
    for channel in animation["channels"]:
        if gltf.name(channel["target"]["node"]) == name:
            sampler = animation["samplers"][channel["sampler"]]
            keys, values = gltf.array(sampler["input"]), gltf.array(sampler["output"])
            found[channel["target"]["path"]] = keys[:, 0], values, sampler["interpolation"]
    return found


def test_a_bone_s_tracks_are_its_poses_in_metres(gltf):
    file, pose = gltf
    found = tracks(file, "femur")
    keys, places, _ = found["translation"]
    np.testing.assert_allclose(keys, [0, 0.2], atol=1e-6)
    np.testing.assert_allclose(places, pose.translation[[0, 2]] / 1e3, atol=1e-7)
    quaternions = found["rotation"][1][:, [3, 0, 1, 2]]
    np.testing.assert_allclose(rotations.from_quaternion(quaternions), pose.rotation[[0, 2]], atol=1e-6)


def test_in_frames_without_a_pose_nothing_is_shown(gltf):
    file, _ = gltf
    for node in ("femur", "centre"):
        keys, size, how = tracks(file, node)["scale"]
        np.testing.assert_allclose(keys, [0, 0.1, 0.2], atol=1e-6)
        np.testing.assert_allclose(size[:, 0], [1, 0, 1])
        assert how == "STEP"


def test_the_scanner_s_head_is_up(gltf):
    file, _ = gltf
    root = next(n for n, node in enumerate(file.nodes) if node["name"] == "knee")
    np.testing.assert_allclose(file.world_from_nodes()[root][:3, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-9)


def test_colours_are_linear_and_bones_let_light_through(gltf):
    file, _ = gltf
    for mesh in file.document["meshes"][:2]:
        part = mesh["primitives"][0]
        colour = file.array(part["attributes"]["COLOR_0"])[0]
        np.testing.assert_allclose(colour, [1, 0.2158605, 0, 1], atol=1e-4)
        clear = file.document["materials"][part["material"]].get("alphaMode") == "BLEND"
        assert clear == (mesh["name"] == "femur")
        normals = file.array(part["attributes"]["NORMAL"])
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
