"""What the same angle, joint centre or segment is called elsewhere, and with which sign."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from marey.arrays import Floats

_OPENSIM_ANGLES = {
    "pelvis_tilt": ("pelvis_tilt", -1.0), "pelvis_list": ("pelvis_obliquity", 1.0),
    "pelvis_rotation": ("pelvis_rotation", 1.0), "lumbar_extension": ("trunk_flexion", -1.0),
    "lumbar_bending": ("trunk_bending", 1.0), "lumbar_rotation": ("trunk_rotation", 1.0),
    "hip_flexion": ("hip_flexion", 1.0), "hip_adduction": ("hip_adduction", 1.0), "hip_rotation": ("hip_rotation", 1.0),
    "knee_angle": ("knee_flexion", 1.0), "ankle_angle": ("ankle_dorsiflexion", 1.0),
    "arm_flex": ("shoulder_flexion", 1.0), "arm_add": ("shoulder_adduction", 1.0),
    "arm_rot": ("shoulder_rotation", 1.0), "elbow_flex": ("elbow_flexion", 1.0),
    "pro_sup": ("forearm_pronation", 1.0), "wrist_flex": ("wrist_flexion", 1.0),
}  # fmt: skip
"""Coordinates of OpenSim's gait models: the anatomical angle and its sign. A subtalar angle is none of ours: its axis
is oblique. (A knee's sign differs from model to model; `hinge_sign` decides it by the knee's own motion.)"""
_ONE_WAY = ("knee_flexion", "elbow_flexion")
_JOINT_WORDS = {
    "hjc": "hip", "kjc": "knee", "ajc": "ankle", "sjc": "shoulder", "ejc": "elbow", "wjc": "wrist", "hip": "hip",
    "knee": "knee", "ankle": "ankle", "shoulder": "shoulder", "elbow": "elbow", "wrist": "wrist",
    "hipcenter": "hip", "kneecenter": "knee", "anklecenter": "ankle", "hipjointcenter": "hip",
    "kneejointcenter": "knee", "anklejointcenter": "ankle", "shouldercenter": "shoulder", "elbowcenter": "elbow",
    "wristcenter": "wrist", "hipcentre": "hip", "kneecentre": "knee", "anklecentre": "ankle",
}  # fmt: skip
_BODIES = {
    "femur": "thigh", "tibia": "shank", "shin": "shank", "humerus": "upperarm", "radius": "forearm", "thigh": "thigh",
    "shank": "shank", "foot": "foot", "toes": "toes", "upperarm": "upperarm", "forearm": "forearm", "hand": "hand",
    "clavicle": "clavicle",
}  # fmt: skip
_MIDDLE_BODIES = {"torso": "thorax", "pelvis": "pelvis", "thorax": "thorax", "head": "head"}
_SIDES = {"l": "left_", "left": "left_", "r": "right_", "right": "right_"}


def known_angle(name: str) -> tuple[str, float] | None:
    """Give our name of an angle and the sign between, or None where the name is nobody's known one."""
    word, side = _split_side(name)
    if word in _OPENSIM_ANGLES and (side or word.startswith(("pelvis", "lumbar"))):
        own, sign = _OPENSIM_ANGLES[word]
        return f"{side}{own}", sign
    return None


def known_point(name: str) -> str | None:
    """Give our name of a joint centre, or None."""
    word, side = _split_side(name)
    own = _JOINT_WORDS.get(re.sub(r"[^a-z]", "", word))
    return f"{side}{own}" if own and side else None


def known_segment(name: str) -> str | None:
    """Give our name of a segment, or None."""
    word, side = _split_side(name)
    if word in _BODIES and side:
        return f"{side}{_BODIES[word]}"
    return _MIDDLE_BODIES.get(word) if not side else None


def _split_side(name: str) -> tuple[str, str]:
    """Take the side off a name: `knee_angle_r`, `RKnee`, `R_KJC`, `RightKneeCenter`, `left_hip`."""
    text = name.strip()
    after = re.fullmatch(r"(.+?)[_\s.]+(l|r|left|right)", text, re.IGNORECASE)
    if after:
        return after[1].lower(), _SIDES[after[2].lower()]
    word = re.fullmatch(r"(left|right)[_\s.]*(.+)", text, re.IGNORECASE)
    if word:
        return word[2].lower(), _SIDES[word[1].lower()]
    letter = re.fullmatch(r"([LRlr])[_\s.]+(.+)|([LR])([A-Z].*)", text)
    if letter:
        return (letter[2] or letter[4]).lower(), _SIDES[(letter[1] or letter[3]).lower()]
    return text.lower(), ""


def hinge_sign(name: str, values: Floats) -> float:
    """Give the sign that makes a hinge's values its flexion: knees and elbows bend one way.

    Args:
        name: Our name of the angle.
        values: (F,) [rad].
    """
    if not name.endswith(_ONE_WAY) or not np.isfinite(values).any():
        return 1.0
    low, high = np.nanpercentile(values, (5, 95))
    return -1.0 if abs(low) > abs(high) and low < 0 else 1.0


def rename_columns(names: Sequence[str], chosen: Mapping[str, str]) -> tuple[list[str], list[float]]:
    """Rename what a user named, `-name` turning the sign, and leave the rest.

    Args:
        names: As a file has them.
        chosen: New name by old one.

    Returns:
        The names, and a sign of each.
    """
    new = [chosen.get(name, name) for name in names]
    return [name.removeprefix("-") for name in new], [-1.0 if name.startswith("-") else 1.0 for name in new]
