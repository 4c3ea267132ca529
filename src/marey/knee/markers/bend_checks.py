"""What shows that a scanned knee is turned round in the laboratory: it bends forwards, or its bones point away.

Balls with other axes than the bones, as RAS instead of LPS, fit the markers of the laboratory as well as right ones:
both bones are turned by 180 degrees together. But a knee bends in one direction only, and the markers of the thigh lie
above the knee, those of the shank below it.
"""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from marey.arrays import Floats
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.anatomical_frames import frame_from_form
from marey.knee.markers.marker_naming import segment_of_bone
from marey.knee.markers.reference_posture import Activity, ReferencePosture
from marey.knee.space.surface import TriangleSurface

_MOST_FRAMES = 100
"""Largest number of frames of an activity that are compared; more do not change a quantile. Chosen for the time."""
_SHARE = 0.05
"""Quantile of the bending over the frames that counts as its extreme, so that single wrong frames do not."""
_NO_BENDS = np.zeros((0, 3, 3))
"""Rotations of an activity that does not have both bones."""


def bends_of(activity: Activity, posture: ReferencePosture, *, left: bool | None) -> Floats:
    """Return the rotations (F, 3, 3) of the tibia's segment in the femur's, over frames of the activity.

    Args:
        activity: Results of `marey markers`.
        posture: The reference posture, whose segments are used.
        left: Whether it is a left knee; None where it is not known.

    Returns:
        At most 100 frames, spread over the activity; none if a segment is missing.
    """
    segments = [segment_of_bone(bone, posture.bones, left=left) for bone in ("femur", "tibia")]
    if None in segments:
        return _NO_BENDS
    thigh, shank = (activity.motion.bone(str(segment))[0] for segment in segments)
    both = np.flatnonzero(np.isfinite(thigh).all((1, 2)) & np.isfinite(shank).all((1, 2)))
    chosen = both[:: max(1, -(-len(both) // _MOST_FRAMES))]
    return np.asarray(np.swapaxes(thigh[chosen], 1, 2) @ shank[chosen])


def forward_bend(
    bones: Mapping[str, TriangleSurface], femur: RigidTransform, tibia: RigidTransform, bends: Floats
) -> float:
    """Return by how much the knee bends forwards at most [rad]; negative if it is always bent backwards.

    Args:
        bones: Surfaces in the scanner.
        femur: The femur's segment from the scanner.
        tibia: The tibia's segment from the scanner.
        bends: (F, 3, 3) rotations of the tibia's segment in the femur's.

    Returns:
        The 95 % quantile over the frames; NaN if the form of a bone does not show its directions.
    """
    above, below = (_directions(bone, bones.get(bone)) for bone in ("femur", "tibia"))
    if not len(bends) or above is None or below is None:
        return float("nan")
    turned = above.T @ femur.rotation.T @ bends @ tibia.rotation @ below
    distal = -turned[:, :, 1]
    return float(np.quantile(np.arctan2(distal[:, 0], -distal[:, 1]), 1 - _SHARE))


def markers_beyond(
    bones: Mapping[str, TriangleSurface], given: Mapping[str, tuple[RigidTransform, Floats]], middle_mm: Floats
) -> float:
    """Return how far the markers of the thigh lie above the knee, or those of the shank below it [mm].

    Args:
        bones: Surfaces in the scanner.
        given: Bone to its segment from the scanner, and the positions (M, 3) of its markers in the segment [mm].
        middle_mm: (3,) the knee's middle in the scanner.

    Returns:
        The larger of the two means along the bones; negative if both bones point away from their markers; NaN if the
        form of a bone does not show its directions, or if it has no markers.
    """
    along = []
    for bone, sign in (("femur", 1.0), ("tibia", -1.0)):
        frame = _directions(bone, bones.get(bone))
        if frame is None or bone not in given:
            return float("nan")
        segment, places = given[bone]
        places = places[np.isfinite(places).all(1)]
        if not len(places):
            return float("nan")
        off = segment.inverse().apply(places).mean(0) - middle_mm
        along.append(sign * float(off @ frame[:, 1]))
    return max(along)


@lru_cache(maxsize=8)
def _directions(bone: str, surface: TriangleSurface | None) -> Floats | None:
    """Return the directions (3, 3) of a bone in the scanner, in columns anterior, proximal, right; None if unknown."""
    frame = None if surface is None else frame_from_form(bone, surface)
    return None if frame is None else frame.rotation
