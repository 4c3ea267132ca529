"""The bone that each marker is attached to: given, by its label's segment, or by its position."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats
from marey.knee.space.structures import BONES
from marey.knee.space.surface import TriangleSurface
from marey.markers.data.labels import segment_from_label

BONE_OF_SEGMENT = {
    "thigh": "femur", "femur": "femur", "shank": "tibia", "leg": "tibia", "tibia": "tibia", "patella": "patella",
}  # fmt: skip
"""Name of a segment, without side, to the bone in it."""
_BY_PLACE = ("femur", "tibia")
"""Bones to which markers are assigned by their position."""
_CLEAR_MM = 5.0
"""Least difference [mm] of the distances to both bones by which a marker is assigned with certainty; chosen by hand."""


def bone_of_segment(segment: str, *, left: bool | None = None) -> str | None:
    """Return the bone of a segment of the laboratory (`left_thigh`: femur); None if it is not part of this knee.

    Args:
        segment: Name of the segment, with or without a side; also as in OpenSim's models (`tibia_r`).
        left: Whether it is a left knee; None where it is not known, or the segments' names have no side.
    """
    for before, after, is_left in (("left_", "_l", True), ("right_", "_r", False)):
        if segment.startswith(before) or segment.endswith(after):
            bare = segment.removeprefix(before).removesuffix(after)
            return None if left not in (None, is_left) else BONE_OF_SEGMENT.get(bare)
    return BONE_OF_SEGMENT.get(segment)


def bone_of_label(label: str, segments: Mapping[str, str], *, left: bool | None = None) -> str | None:
    """Return the bone of a label: by its given segment, else by its own name (`tibia_02`).

    Args:
        label: Label of a marker in the laboratory.
        segments: Label to segment, where it is known.
        left: As for `bone_of_segment`.
    """
    named = segments.get(label) or segment_from_label(label)
    return None if named is None else bone_of_segment(named, left=left)


def may_be_on(label: str, bone: str, segments: Mapping[str, str], *, left: bool | None = None) -> bool:
    """Return whether a label may be on a bone: neither the activity nor its name assigns it to another one.

    Args:
        label: Label of a marker in the laboratory.
        bone: Name of a bone of the knee.
        segments: Label to segment, where it is known.
        left: As for `bone_of_segment`.
    """
    if label in segments:
        return bone_of_segment(segments[label], left=left) == bone
    return bone_of_label(label, segments, left=left) in (None, bone)


def bones_by_place(places_mm: Floats, bones: Mapping[str, TriangleSurface]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Assign each marker to the nearer one of femur and tibia.

    The assignment is uncertain if the other bone is about as near. No marker is assigned to the patella, which slides
    beneath its skin.

    Args:
        places_mm: (M, 3) LPS.
        bones: Surfaces of the bones by name.

    Returns:
        (M,) bones, and the indices of the markers whose assignment is uncertain.
    """
    there = [bone for bone in _BY_PLACE if bone in bones]
    distance = np.stack([cKDTree(bones[bone].vertices_mm).query(places_mm)[0] for bone in there], 1)
    nearest = tuple(there[k] for k in distance.argmin(1).tolist())
    if len(there) < 2:
        return nearest, ()
    uncertain = np.flatnonzero(np.abs(distance[:, 0] - distance[:, 1]) < _CLEAR_MM)
    return nearest, tuple(uncertain.tolist())


def in_order(bones: Mapping[str, object]) -> tuple[str, ...]:
    """Return the names of bones in the order femur, tibia, patella."""
    return tuple(bone for bone in BONES if bone in bones)
