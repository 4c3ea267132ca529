"""Colours and lines of a body, the same in all images: left side cool, right side warm, trunk violet."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Image, Integers

OTHER = "#8a8f98"
"""Colour of segments that are not in `SEGMENTS`, as #rrggbb."""
SEGMENTS = {
    "pelvis": "#7d6bb0", "abdomen": "#9280c4", "thorax": "#6a5fa8", "neck": "#a596d0", "head": "#8674bd",
    "left_clavicle": "#4f74b3", "left_upperarm": "#2f6db5", "left_forearm": "#3b94c9", "left_hand": "#6cb7dd",
    "left_thigh": "#1f7f83", "left_shank": "#2fa39a", "left_foot": "#66c2a5", "left_toes": "#9bd8bf",
    "right_clavicle": "#b8636b", "right_upperarm": "#c0453f", "right_forearm": "#dc6f4a", "right_hand": "#ee9f74",
    "right_thigh": "#b0791f", "right_shank": "#d39a2f", "right_foot": "#e3bb5c", "right_toes": "#efd694",
}  # fmt: skip
"""Colour of each segment, as #rrggbb. Chosen by eye."""

LEFT, RIGHT, MIDDLE = "#2f6db5", "#c0453f", "#5d5a88"
"""Colours of joints and angles of the left side, the right side and the trunk, as #rrggbb. Chosen by eye."""

_BONES = (
    ("neck", "head"),
    *((f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in (
        ("hip", "knee"), ("knee", "ankle"), ("ankle", "toe"), ("shoulder", "elbow"), ("elbow", "wrist"),
        ("hip", "shoulder"),
    )),
    ("left_hip", "right_hip"), ("left_shoulder", "neck"), ("right_shoulder", "neck"),
)  # fmt: skip
"""Pairs of joints that are joined by a line."""


def segment_colours(names: Sequence[str]) -> Image:
    """Return the colours (S, 3) of segments in red, green, blue."""
    texts = [SEGMENTS.get(name, OTHER) for name in names]
    return np.array([[int(text[i : i + 2], 16) for i in (1, 3, 5)] for text in texts], np.uint8).reshape(-1, 3)


def side_colour(name: str) -> str:
    """Return the colour of a joint or angle by its side, as #rrggbb."""
    return LEFT if name.startswith("left_") else RIGHT if name.startswith("right_") else MIDDLE


def bone_pairs(joint_names: Sequence[str]) -> Integers:
    """Return the indices (n, 2) of the given joints that are joined by a line."""
    index = {name: i for i, name in enumerate(joint_names)}
    pairs = [(index[a], index[b]) for a, b in _BONES if a in index and b in index]
    return np.array(pairs, np.int64).reshape(-1, 2)
