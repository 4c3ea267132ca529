"""Identification of joints by their names."""

import pytest
from tests import rigs

from marey.body.articulation.skeleton import PARENTS
from marey.io.gltf.rig_names import name_joints, words_of


@pytest.mark.parametrize(
    ("name", "side", "words"),
    [
        ("mixamorig:LeftUpLeg", "left", "upleg"), ("mixamorig1:RightArm", "right", "arm"),
        ("thigh_l", "left", "thigh"), ("mixamorigLeftFoot", "left", "foot"), ("rShldrBend", "right", "shldrbend"),
        ("DEF-upper_arm.R.001", "right", "upperarm"), ("Bip01 L Calf", "left", "calf"),
        ("J_Bip_C_UpperChest", None, "upperchest"), ("LHipJoint", "left", "hip"), ("leftfoot", "left", "foot"),
        ("LeftHandThumb1", "left", "handthumb"), ("left_toes", "left", "toes"), ("Hips", None, "hips"), ("", None, ""),
    ],
)  # fmt: skip
def test_a_name_is_split_into_side_and_words(name, side, words):
    assert words_of(name) == (side, words)


EXPECTED = {
    "mixamo": tuple(f"mixamorig:{name}" for name in ("Hips", "Spine", "Spine2", "Neck", "LeftArm", "LeftLeg")),
    "unreal": ("pelvis", "spine_01", "spine_03", "neck_01", "upperarm_l", "calf_l"),
    "rigify": ("DEF-spine", "DEF-spine.001", "DEF-spine.003", "DEF-spine.004", "DEF-upper_arm.L", "DEF-shin.L"),
    "smpl": ("Pelvis", "Spine1", "Spine3", "Neck", "L_Shoulder", "L_Knee"),
    "biped": ("Bip01 Pelvis", "Bip01 Spine", "Bip01 Spine1", "Bip01 Neck", "Bip01 L UpperArm", "Bip01 L Calf"),
    "vroid": tuple(
        f"J_Bip_{name}" for name in ("C_Hips", "C_Spine", "C_UpperChest", "C_Neck", "L_UpperArm", "L_LowerLeg")
    ),
    "daz": ("hip", "abdomenLower", "chestUpper", "neckLower", "lShldrBend", "lShin"),
    "cmu": ("Hips", "LowerBack", "Spine1", "Neck", "LeftArm", "LeftLeg"),
    "unreal5": ("pelvis", "spine_01", "spine_03", "neck_01", "upperarm_l", "calf_l"),
    "human_ik": ("Hips", "Spine", "Spine1", "Neck", "LeftArm", "LeftLeg"),
    "rigify_split": ("DEF-spine", "DEF-spine.001", "DEF-spine.003", "DEF-spine.004", "DEF-upper_arm.L", "DEF-shin.L"),
}  # fmt: skip


def named(text: str, known: dict[str, str] | None = None) -> dict[str, str]:
    names, parents = rigs.tree(text)
    found = name_joints(
        dict(enumerate(names)),
        {n: p for n, p in enumerate(parents) if p >= 0},
        {segment: names.index(name) for segment, name in (known or {}).items()},
    )
    return {segment: names[n] for segment, n in found.items()}


@pytest.mark.parametrize("rig", rigs.RIGS)
def test_every_segment_of_the_usual_rigs_is_found(rig):
    found = named(rigs.RIGS[rig])
    assert set(found) == set(PARENTS)
    assert len(set(found.values())) == len(found)
    requested = ("pelvis", "abdomen", "thorax", "neck", "left_upperarm", "left_shank")
    assert tuple(found[s] for s in requested) == EXPECTED[rig]


def test_the_names_of_our_segments_are_recognised():
    lines = {None: 0}
    text = ""
    for name, parent in PARENTS.items():
        lines[name] = lines[parent] + 1
    plain = [n for n in PARENTS if not n.startswith("right_")]
    order = ["pelvis", "abdomen", "thorax", "neck", "head", *[n for n in plain if n.startswith("left_")]]
    for name in order:
        text += " " * lines[name] + name.replace("left", "{S}") + "\n"
    found = named(text)
    assert all(segment == name.lower() for segment, name in found.items())
    assert set(found) == set(PARENTS)


def test_known_joints_are_not_changed():
    assert named(rigs.MIXAMO, {"thorax": "mixamorig:Spine1"})["thorax"] == "mixamorig:Spine1"


def test_a_rig_with_unknown_names_has_no_joints():
    assert named("bone_0\n bone_1\n  bone_2\n") == {}
