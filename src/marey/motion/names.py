"""Names of angles, joint centres and segments in other programs, with the signs of angles."""

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
"""Maps coordinates of OpenSim's gait models to the anatomical angle and its sign. The subtalar angle has no
counterpart, because its axis is oblique. The sign of the knee differs between models; `hinge_sign` determines it from
the motion."""
_HINGES = ("knee_flexion", "elbow_flexion")
"""Angles of joints that bend in one direction only."""
_JOINT_WORDS = {
    "hjc": "hip", "kjc": "knee", "ajc": "ankle", "sjc": "shoulder", "ejc": "elbow", "wjc": "wrist", "hip": "hip",
    "knee": "knee", "ankle": "ankle", "shoulder": "shoulder", "elbow": "elbow", "wrist": "wrist",
    "hipcenter": "hip", "kneecenter": "knee", "anklecenter": "ankle", "hipjointcenter": "hip",
    "kneejointcenter": "knee", "anklejointcenter": "ankle", "shouldercenter": "shoulder", "elbowcenter": "elbow",
    "wristcenter": "wrist", "hipcentre": "hip", "kneecentre": "knee", "anklecentre": "ankle",
}  # fmt: skip
"""Maps words for joint centres in other programs, in lower case, to our joints."""
_BODIES = {
    "femur": "thigh", "tibia": "shank", "shin": "shank", "humerus": "upperarm", "radius": "forearm", "thigh": "thigh",
    "shank": "shank", "foot": "foot", "toes": "toes", "upperarm": "upperarm", "forearm": "forearm", "hand": "hand",
    "clavicle": "clavicle",
}  # fmt: skip
"""Maps bodies of the limbs in other programs to our segments."""
_MIDDLE_BODIES = {"torso": "thorax", "pelvis": "pelvis", "thorax": "thorax", "head": "head"}
"""Maps bodies without a side in other programs to our segments."""
_SIDES = {"l": "left_", "left": "left_", "r": "right_", "right": "right_"}
"""Maps designations of a side to our prefix."""


def known_angle(name: str) -> tuple[str, float] | None:
    """Return our name of an angle and the relative sign, or None for an unknown name."""
    word, side = _split_side(name)
    if word in _OPENSIM_ANGLES and (side or word.startswith(("pelvis", "lumbar"))):
        own, sign = _OPENSIM_ANGLES[word]
        return f"{side}{own}", sign
    return None


def known_point(name: str) -> str | None:
    """Return our name of a joint centre, or None for an unknown name."""
    word, side = _split_side(name)
    own = _JOINT_WORDS.get(re.sub(r"[^a-z]", "", word))
    return f"{side}{own}" if own and side else None


def known_segment(name: str) -> str | None:
    """Return our name of a segment, or None for an unknown name."""
    word, side = _split_side(name)
    if word in _BODIES and side:
        return f"{side}{_BODIES[word]}"
    return _MIDDLE_BODIES.get(word) if not side else None


def _split_side(name: str) -> tuple[str, str]:
    """Split the side from a name: `knee_angle_r`, `RKnee`, `R_KJC`, `RightKneeCenter`, `left_hip`."""
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
    """Return the sign that makes a hinge's values positive in flexion: knees and elbows bend in one direction only.

    Args:
        name: Our name of the angle.
        values: (F,) angle [rad].

    Returns:
        1 or -1; 1 for joints that are not hinges.
    """
    if not name.endswith(_HINGES) or not np.isfinite(values).any():
        return 1.0
    low, high = np.nanpercentile(values, (5, 95))
    return -1.0 if abs(low) > abs(high) and low < 0 else 1.0


def rename_columns(names: Sequence[str], chosen: Mapping[str, str]) -> tuple[list[str], list[float]]:
    """Rename the columns that a user specified, and keep the others.

    Args:
        names: Names of the columns in a file.
        chosen: Maps old names to new ones; a new name `-name` also changes the sign.

    Returns:
        The names, and the sign of each.
    """
    new = [chosen.get(name, name) for name in names]
    return [name.removeprefix("-") for name in new], [-1.0 if name.startswith("-") else 1.0 for name in new]
