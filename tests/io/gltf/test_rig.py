"""Motions on other characters, as a viewer shows the written files."""

import json

import numpy as np
import pytest
from tests import rigs
from tests.rigs import write_retargeted

from marey.errors import FileProblem
from marey.geometry import rotations
from marey.io.axes import GLTF_FROM_WORLD
from marey.io.gltf.rig import read_map, read_rig
from marey.io.gltf.rig_names import name_joints
from marey.motion.retarget import REQUIRED_SEGMENTS, rest_joints
from marey.motion.twist import twist_angles

BONES = [("thigh", "shank"), ("shank", "foot"), ("upperarm", "forearm"), ("forearm", "hand")]
POSTURES = {
    "mixamo": ("t", 0.01), "unreal": ("a", 1.0), "rigify": ("t", 1.0), "smpl": ("t", 1.0), "biped": ("a", 0.0254),
    "vroid": ("t", 1.0), "daz": ("a", 0.01), "cmu": ("t", 0.05), "unreal5": ("a", 0.01),
    "human_ik": ("t", 1.0), "rigify_split": ("t", 1.0),
}  # fmt: skip


def segments(text: str) -> dict[str, str]:
    """Return the segment by the name of its joint."""
    names, parents = rigs.tree(text)
    found = name_joints(dict(enumerate(names)), {n: p for n, p in enumerate(parents) if p >= 0}, {})
    return {names[n]: segment for segment, n in found.items()}


def written(tmp_path, rig: str, motion, *, floor=None, grounded=True, **changes):
    """Write a character and its animated copy, and evaluate the copy."""
    text, (arms, unit) = rigs.RIGS[rig], POSTURES[rig]
    source, path = tmp_path / "character.glb", tmp_path / "moved.glb"
    rigs.write_rig(source, text, segments(text), **({"arms": arms, "unit": unit} | changes))
    write_retargeted(path, *read_rig(source), motion, floor=floor, grounded=grounded)
    time, world = rigs.play(*rigs.open_glb(path))
    places = {s: world[n][:, :3, 3] @ np.asarray(GLTF_FROM_WORLD) for n, s in segments(text).items()}
    return time, world, places


def unit(vector):
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


@pytest.mark.parametrize("rig", rigs.RIGS)
def test_arms_and_legs_have_the_directions_of_the_person_s(tmp_path, motion, rig):
    time, _, places = written(tmp_path, rig, motion)
    known = np.flatnonzero(motion.answered)
    np.testing.assert_allclose(time, motion.time[known], atol=1e-6)
    for side in ("left", "right"):
        for start, end in BONES:
            theirs = unit(places[f"{side}_{end}"] - places[f"{side}_{start}"])
            origin = [motion.segment_origin[known, motion.segment_names.index(f"{side}_{n}")] for n in (start, end)]
            angle = np.linalg.norm(np.cross(theirs, unit(origin[1] - origin[0])), axis=1)
            assert angle.max() < 2e-5, f"{side} {start}"
            assert ((theirs * unit(origin[1] - origin[0])).sum(1) > 0).all()


def test_the_trunk_rotates_as_the_person_s(tmp_path, motion):
    _, world, _ = written(tmp_path, "mixamo", motion, bones=False, unit=1.0)
    known = np.flatnonzero(motion.answered)
    back = np.asarray(GLTF_FROM_WORLD).T
    for name, segment in (("mixamorig:Hips", "pelvis"), ("mixamorig:Spine2", "thorax"), ("mixamorig:Head", "head")):
        # At rest the character faces along Z of the scene, which is -Y of the world, as the person does.
        np.testing.assert_allclose(
            back @ world[name][:, :3, :3] @ back.T, motion.segment(segment)[known], atol=2e-6, err_msg=name
        )


def twist_of(world, upper, lower):
    """Return the twist of a joint relative to another one in each frame, relative to the first frame."""
    turn = [m[:, :3, :3] / np.linalg.norm(m[:, :3, :3], axis=1, keepdims=True) for m in (world[upper], world[lower])]
    relative = np.swapaxes(turn[0], 1, 2) @ turn[1]
    return relative @ np.swapaxes(relative[:1], 1, 2)


TWISTING = {
    "unreal5": ("lowerarm_l", [("lowerarm_twist_02_l", 0.33), ("lowerarm_twist_01_l", 0.67)], "upperarm_l"),
    "human_ik": ("LeftForeArm", [("LeftForeArmRoll", 0.5)], "LeftArm"),
    "rigify_split": ("DEF-forearm.L", [("DEF-forearm.L.001", 0.5)], "DEF-upper_arm.L"),
}


@pytest.mark.parametrize("rig", TWISTING)
def test_twist_joints_share_the_rotation_about_the_limb(tmp_path, motion, rig):
    _, world, _ = written(tmp_path, rig, motion, bones=False)
    known = np.flatnonzero(motion.answered)
    names = list(motion.segment_names)
    axis = rest_joints(motion)[names.index("left_hand")] - rest_joints(motion)[names.index("left_forearm")]
    upper, lower = (motion.segment(f"left_{n}")[known] for n in ("upperarm", "forearm"))
    twist = twist_angles(np.swapaxes(upper, 1, 2) @ lower, axis)
    assert np.ptp(twist) > 0.5
    first, others, _ = TWISTING[rig]
    # The boxes of skin are at the joints, so that their position along the limb is the share.
    for name, share in others:
        turn = twist_of(world, first, name)
        angle = np.linalg.norm(rotations.log(turn), axis=1)
        start = 0.01  # The box at the elbow extends a little along the forearm.
        np.testing.assert_allclose(angle, np.abs((share - start) * (twist - twist[0])), atol=0.06 * np.ptp(twist))


def test_limbs_with_one_joint_have_no_twist_joints(tmp_path):
    for rig in ("mixamo", "smpl", "vroid", "biped"):
        text, (arms, unit) = rigs.RIGS[rig], POSTURES[rig]
        rigs.write_rig(tmp_path / "character.glb", text, segments(text), arms=arms, unit=unit)
        assert read_rig(tmp_path / "character.glb")[1].twists == {}


def test_spine_joints_between_two_segments_share_the_rotation(tmp_path, motion):
    _, world, _ = written(tmp_path, "mixamo", motion, bones=False, unit=1.0)

    def angle(a, b):
        turn = np.swapaxes(world[f"mixamorig:{a}"][:, :3, :3], 1, 2) @ world[f"mixamorig:{b}"][:, :3, :3]
        return np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))

    half = angle("Spine", "Spine1")
    np.testing.assert_allclose(half, angle("Spine1", "Spine2"), atol=1e-3)
    np.testing.assert_allclose(half, angle("Spine", "Spine2") / 2, atol=1e-3)
    assert half.max() > 0.1


@pytest.mark.parametrize("size", [0.5, 1.7])
def test_the_length_of_steps_is_proportional_to_the_legs(tmp_path, motion, size):
    known = np.flatnonzero(motion.answered)
    _, _, places = written(tmp_path, "unreal", motion, size=size)
    names = list(motion.segment_names)

    def hips(of):
        return 0.5 * (of("left_thigh") + of("right_thigh"))

    own = hips(lambda name: motion.segment_origin[known, names.index(name)])
    lengths = [
        sum(np.linalg.norm(of(f"left_{b}")[0] - of(f"left_{a}")[0]) for a, b in BONES[:2])
        for of in (places.__getitem__, lambda name: motion.segment_origin[known, names.index(name)])
    ]
    theirs = hips(places.__getitem__)
    np.testing.assert_allclose(theirs[:, :2], lengths[0] / lengths[1] * own[:, :2], atol=1e-5)


def test_the_lower_foot_has_the_height_of_the_person_s(tmp_path, motion, person):
    known = np.flatnonzero(motion.answered)
    floor = float(person.vertices[:, 2].min() - person.joint_centres[0, 2])
    _, _, places = written(tmp_path, "mixamo", motion, floor=floor)
    rest = rigs.rest_places("t")
    lowest = min(p[1] for p in rest.values())
    names, own_rest = list(motion.segment_names), dict(zip(motion.segment_names, person.joint_centres, strict=True))
    length = [sum(np.linalg.norm(at[f"left_{b}"] - at[f"left_{a}"]) for a, b in BONES[:2]) for at in (rest, own_rest)]
    size = length[0] / length[1]
    theirs, own = [], []
    for side in ("left", "right"):
        for part in ("foot", "toes"):
            name = f"{side}_{part}"
            theirs.append(places[name][:, 2] - (rest[name][1] - lowest))
            above = own_rest[name][2] - person.vertices[:, 2].min()
            own.append(size * (motion.segment_origin[known, names.index(name), 2] - above))
    np.testing.assert_allclose(np.min(theirs, axis=0), np.min(own, axis=0), atol=1e-5)


def test_a_motion_on_its_own_body_is_unchanged(tmp_path, motion, person):
    from marey.io.gltf.glb import write_glb

    write_glb(tmp_path / "body.glb", person, motion)
    path = tmp_path / "moved.glb"
    floor = float(person.vertices[:, 2].min() - person.joint_centres[0, 2])
    write_retargeted(path, *read_rig(tmp_path / "body.glb"), motion, floor=floor)
    document, binary = rigs.open_glb(path)
    (_, first), (_, second) = (rigs.play(document, binary, number) for number in (0, 1))
    for name in first:
        np.testing.assert_allclose(second[name], first[name], atol=2e-6, err_msg=name)


def test_mirrored_joints_move_right(tmp_path, motion):
    """Some programs mirror the right side by a negative scale."""

    def mirror(document):
        for node in document["nodes"]:
            if node["name"] == "thigh_r":
                node["scale"] = [-1, 1, 1]

    _, _, places = written(tmp_path, "unreal", motion, change=mirror)
    known = np.flatnonzero(motion.answered)
    names = list(motion.segment_names)
    thigh, shank = (motion.segment_origin[known, names.index(f"right_{n}")] for n in ("thigh", "shank"))
    np.testing.assert_allclose(unit(places["right_shank"] - places["right_thigh"]), unit(shank - thigh), atol=2e-5)


def test_nodes_with_matrices_are_animated(tmp_path, motion):
    def as_matrices(document):
        from marey.io.gltf.gltf import local_matrix

        for node in document["nodes"][1:-1]:
            matrix = local_matrix(node).T.ravel().tolist()
            for key in ("translation", "rotation", "scale"):
                node.pop(key, None)
            node["matrix"] = matrix

    _, _, places = written(tmp_path, "smpl", motion, change=as_matrices)
    _, _, same = written(tmp_path, "smpl", motion)
    for name, place in places.items():
        np.testing.assert_allclose(place, same[name], atol=1e-5)


def test_nothing_else_of_the_file_changes(tmp_path, motion):
    def theirs(document):
        document["animations"] = [{"name": "idle", "channels": [], "samplers": []}]
        document["extensionsUsed"] = ["THEIR_thing"]
        document["extensions"] = {"THEIR_thing": {"of": [1, 2.5, "ü"]}}

    written(tmp_path, "mixamo", motion, change=theirs)
    (old, before), (new, after) = (rigs.open_glb(tmp_path / f"{name}.glb") for name in ("character", "moved"))
    assert after.startswith(before[: old["buffers"][0]["byteLength"]])
    for key in ("accessors", "bufferViews", "animations"):
        assert new[key][: len(old[key])] == old[key]
    same = set(old) - {"accessors", "bufferViews", "animations", "buffers"}
    assert {key: new[key] for key in same} == {key: old[key] for key in same}
    assert set(new) == set(old)
    assert len(new["animations"]) == 2


def test_gaps_have_no_keys_and_are_listed(tmp_path, motion):
    time, _, _ = written(tmp_path, "smpl", motion)
    assert len(time) == motion.answered.sum() < len(motion)
    document, _ = rigs.open_glb(tmp_path / "moved.glb")
    (first, after), *_ = motion.gaps()
    assert document["animations"][-1]["extras"]["gaps"] == [[motion.time[first - 1], motion.time[after]]]


def test_successive_quaternions_have_the_same_sign(tmp_path, motion):
    written(tmp_path, "rigify", motion)
    document, binary = rigs.open_glb(tmp_path / "moved.glb")
    for accessor in document["accessors"]:
        if (
            accessor["type"] == "VEC4"
            and accessor["componentType"] == 5126
            and accessor["count"] == motion.answered.sum()
        ):
            start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
            q = np.frombuffer(binary, "<f4", 4 * accessor["count"], start).reshape(-1, 4)
            assert ((q[1:] * q[:-1]).sum(1) > 0).all()
            np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-6)


def test_a_gltf_with_a_separate_buffer_remains_a_gltf(tmp_path, motion):
    source, path = tmp_path / "character.gltf", tmp_path / "moved.gltf"
    rigs.write_rig(source, rigs.SMPL, segments(rigs.SMPL))
    write_retargeted(path, *read_rig(source), motion, floor=None)
    new, old = json.loads(path.read_text()), json.loads(source.read_text())
    assert new["buffers"][0] == old["buffers"][0]
    assert new["buffers"][1]["uri"].startswith("data:application/octet-stream;base64,")


def test_declared_joints_of_a_vrm_are_used(tmp_path, motion):
    text = rigs.VROID
    names, _ = rigs.tree(text)

    def anonymous(document):
        found = {segment: names.index(name) + 1 for name, segment in segments(text).items()}
        declared = {"hips": "pelvis", "head": "head", "neck": "neck"}
        for side in ("left", "right"):
            declared |= {f"{side}{b}": f"{side}_{s}" for b, s in (
                ("UpperLeg", "thigh"), ("LowerLeg", "shank"), ("Foot", "foot"), ("Toes", "toes"),
                ("UpperArm", "upperarm"), ("LowerArm", "forearm"), ("Hand", "hand"), ("Shoulder", "clavicle"))
            }  # fmt: skip
        bones = {bone: {"node": found[segment]} for bone, segment in declared.items()}
        document["extensions"] = {"VRMC_vrm": {"specVersion": "1.0", "humanoid": {"humanBones": bones}}}
        for n, node in enumerate(document["nodes"]):
            node["name"] = f"n{n}"

    rigs.write_rig(tmp_path / "character.glb", text, segments(text), change=anonymous)
    _, rig = read_rig(tmp_path / "character.glb")
    assert {names[n - 1]: s for s, n in rig.nodes.items()} == segments(text)


def test_joints_are_named_by_a_map(tmp_path, motion):
    def renamed(document):
        for node in document["nodes"]:
            node["name"] = node["name"].replace("L_Knee", "Gonk")

    path = tmp_path / "character.glb"
    rigs.write_rig(path, rigs.SMPL, segments(rigs.SMPL), change=renamed)
    assert read_rig(path)[1].guessed == ("left_shank",)
    (tmp_path / "map.toml").write_text('[joints]\nleft_knee = "Gonk"\n')
    gltf, rig = read_rig(path, read_map(tmp_path / "map.toml"))
    assert gltf.name(rig.nodes["left_shank"]) == "Gonk"
    assert rig.guessed == ()
    with pytest.raises(FileProblem, match=r"no joint named 'Gonkk', given for left_shank. It has .*Gonk,"):
        read_rig(path, {"left_shank": "Gonkk"})


def test_joints_found_neither_by_name_nor_by_position_are_listed(tmp_path):
    text = rigs.SMPL.replace("   {U}_Ankle\n    {U}_Foot\n", "").replace("{U}_Wrist", "{U}_Gonk")
    rigs.write_rig(tmp_path / "character.glb", text, segments(text))
    with pytest.raises(
        FileProblem, match=r"left_foot.* right_foot.*recognised joints: pelvis = Pelvis.*other joints: .*L_Gonk.*--map"
    ):
        read_rig(tmp_path / "character.glb")


def nameless(document):
    for n, node in enumerate(document["nodes"]):
        node["name"] = f"bone{n}"


@pytest.mark.parametrize(
    "rig", ["mixamo", "unreal", "smpl", "vroid", "cmu", "human_ik", "rigify", "rigify_split", "daz", "unreal5"]
)
@pytest.mark.parametrize("turned", [False, True])
def test_joints_with_unknown_names_are_found_by_position(tmp_path, rig, turned):
    text, (arms, unit) = rigs.RIGS[rig], POSTURES[rig]
    path = tmp_path / "character.glb"
    rigs.write_rig(path, text, segments(text), arms=arms, unit=unit, turned=turned, change=nameless)
    _, found = read_rig(path)
    names, _ = rigs.tree(text)
    expected = segments(text)
    assert {names[n - 1]: s for s, n in found.nodes.items() if s in REQUIRED_SEGMENTS} == {
        n: s for n, s in expected.items() if s in REQUIRED_SEGMENTS
    }
    assert all(
        expected.get(names[n - 1], s) == s for s, n in found.nodes.items() if "neck" not in s and "head" not in s
    )
    assert set(REQUIRED_SEGMENTS) <= set(found.guessed)


def test_joints_are_not_guessed_for_a_rig_without_the_shape_of_a_person(tmp_path):
    text = "a\n b\n  c\n   d\n  e\n   f\n"
    rigs.write_rig(tmp_path / "character.glb", text, {})
    with pytest.raises(FileProblem, match="recognised joints: none; other joints: "):
        read_rig(tmp_path / "character.glb")


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("left_thigh = 'a'", "does not contain exactly one table"), ("[joints]\nleft_thing = 'a'", "left_thing"),
        ("[joints", "is not TOML"),
        ("[joints]\n[other]\n", "does not contain exactly one table"),
    ],
)  # fmt: skip
def test_an_invalid_map_is_an_error_that_states_the_problem(tmp_path, text, wrong):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(FileProblem, match=wrong):
        read_map(tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("data", "wrong"),
    [
        (b"nothing at all, and long enough to be read", "is not a GLB"), (b"", "is not a GLB"),
        (b"glTF\2\0\0\0", "is not a GLB"),
        (b'{"asset": {"version": "1.0"}}', "is glTF 1.0"), (b'{"asset": {"version": "2.0"}}', "no skinned mesh"),
        (b"[]", "is not a GLB"),
        (b'{"asset": {"version": "2.0"}, "nodes": [{"mesh": 0, "skin": 0}]}', "a mesh that does not exist"),
    ],
)  # fmt: skip
def test_a_file_that_is_not_a_character_is_rejected(tmp_path, data, wrong):
    (tmp_path / "character.glb").write_bytes(data)
    with pytest.raises(FileProblem, match=wrong):
        read_rig(tmp_path / "character.glb")


def test_a_lying_character_and_a_wrong_tree_are_rejected(tmp_path, motion):
    def lying(document):
        document["nodes"][0]["rotation"] = [0.30, 0.30, 0.30, 0.854]

    rigs.write_rig(tmp_path / "a.glb", rigs.SMPL, segments(rigs.SMPL), change=lying)
    with pytest.raises(FileProblem, match="stand upright"):
        write_retargeted(tmp_path / "b.glb", *read_rig(tmp_path / "a.glb"), motion, floor=None)
    rigs.write_rig(tmp_path / "a.glb", rigs.SMPL, segments(rigs.SMPL))
    gltf, rig = read_rig(tmp_path / "a.glb", {"left_shank": "L_Elbow", "left_forearm": "L_Knee"})
    with pytest.raises(FileProblem, match="left_forearm is not a descendant of that of left_upperarm"):
        write_retargeted(tmp_path / "b.glb", gltf, rig, motion, floor=None)
    assert not (tmp_path / "b.glb").exists()
