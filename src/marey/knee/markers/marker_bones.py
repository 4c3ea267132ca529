"""Which bone a marker rides on: said, told by its label's segment, or told by its place."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats
from marey.knee.space.structures import BONES
from marey.knee.space.surface import Surface
from marey.markers.data.labels import segment_from_label

BONE_OF_SEGMENT = {
    "thigh": "femur", "femur": "femur", "shank": "tibia", "leg": "tibia", "tibia": "tibia", "patella": "patella",
}  # fmt: skip
_BY_PLACE = ("femur", "tibia")
_CLEAR_MM = 5.0


def bone_of_segment(segment: str, *, left: bool | None = None) -> str | None:
    """Return the bone of a segment of the laboratory (`left_thigh`: femur); None for one that is no part of this knee.

    Args:
        segment: Its name, with or without a side; also as OpenSim's models have it (`tibia_r`).
        left: Which knee it is; None where it is not known, or the names of the segments tell no side.
    """
    for before, after, is_left in (("left_", "_l", True), ("right_", "_r", False)):
        if segment.startswith(before) or segment.endswith(after):
            bare = segment.removeprefix(before).removesuffix(after)
            return None if left not in (None, is_left) else BONE_OF_SEGMENT.get(bare)
    return BONE_OF_SEGMENT.get(segment)


def bone_of_label(label: str, segments: Mapping[str, str], *, left: bool | None = None) -> str | None:
    """Return the bone that a label tells: by the segment it is said to ride on, else by its own name (`tibia_02`).

    Args:
        label: Of the laboratory.
        segments: Label to segment, where it is known.
        left: As `bone_of_segment`.
    """
    named = segments.get(label) or segment_from_label(label)
    return None if named is None else bone_of_segment(named, left=left)


def may_ride(label: str, bone: str, segments: Mapping[str, str], *, left: bool | None = None) -> bool:
    """Return whether a label may be on a bone: the activity puts it nowhere else, and its name says nothing else.

    Args:
        label: Of the laboratory.
        bone: Of the knee.
        segments: Label to segment, where it is known.
        left: As `bone_of_segment`.
    """
    if label in segments:
        return bone_of_segment(segments[label], left=left) == bone
    return bone_of_label(label, segments, left=left) in (None, bone)


def bones_by_place(places_mm: Floats, bones: Mapping[str, Surface]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Take each marker to the nearer one of femur and tibia.

    A marker that lies about as near to the other bone counts as doubtful. No marker is given to the patella, which
    slides beneath the skin over it.

    Args:
        places_mm: (M, 3) LPS.
        bones: By name.

    Returns:
        (M,) bones, and which of the markers are doubtful.
    """
    there = [bone for bone in _BY_PLACE if bone in bones]
    distance = np.stack([cKDTree(bones[bone].vertices_mm).query(places_mm)[0] for bone in there], 1)
    nearest = tuple(there[k] for k in distance.argmin(1).tolist())
    if len(there) < 2:
        return nearest, ()
    doubtful = np.flatnonzero(np.abs(distance[:, 0] - distance[:, 1]) < _CLEAR_MM)
    return nearest, tuple(doubtful.tolist())


def in_order(bones: Mapping[str, object]) -> tuple[str, ...]:
    """Return the names of bones as the knee has them: femur, tibia, patella."""
    return tuple(bone for bone in BONES if bone in bones)
