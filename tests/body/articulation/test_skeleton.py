"""The parts into which a skeleton's segments are divided."""

import numpy as np
from tests import worlds

from marey.body.articulation.skeleton import COLOUR_PARTS

EXPECTED = {
    "head": ["neck", "head"],
    "trunk": ["abdomen", "thorax", "left_clavicle", "right_clavicle"],
    "pelvis": ["pelvis"],
    "foot": ["left_foot", "left_toes", "right_foot", "right_toes"],
} | {part: [f"left_{part}", f"right_{part}"] for part in ("upperarm", "forearm", "hand", "thigh", "shank")}


def test_both_sides_and_small_segments_share_the_colours_of_a_part():
    skeleton = worlds.person().skeleton
    found: dict[str, list[str]] = {part: [] for part in COLOUR_PARTS}
    for name, part in zip(skeleton.segment_names, skeleton.segment_colour_part, strict=True):
        found[COLOUR_PARTS[part]].append(name)
    assert {part: set(names) for part, names in found.items()} == {part: set(n) for part, n in EXPECTED.items()}


def test_a_face_has_the_colours_of_its_segment():
    body = worlds.person()
    np.testing.assert_array_equal(body.face_colour_part, body.skeleton.segment_colour_part[body.face_segment])
    assert set(body.face_colour_part) == set(range(len(COLOUR_PARTS)))
