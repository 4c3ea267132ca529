"""Planted feet: detection in a motion, and correction on a character with other proportions."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations

_LARGEST_EXTENSION = 0.999
"""Largest extension of a leg as a ratio to its length, because a straight leg has no bending direction. Chosen by
hand."""
_SMALLEST_EXTENSION = 1.001
"""Smallest extension of a leg as a ratio to the difference of thigh and shank; numerical."""
_GAP_RATIO = 1.5
"""Two frames farther apart than this multiple of the median time step are separated by a gap."""


@dataclass(frozen=True, kw_only=True)
class StanceSettings:
    """Settings of the detection of stances.

    The defaults were chosen by hand; results were not measured against other values.
    """

    largest_speed: float = 0.3
    """Largest speed of the supporting joint of a planted foot [m/s]."""
    largest_height_m: float = 0.06
    """Largest height of that joint above the ground [m]."""
    largest_shift_m: float = 0.03
    """Largest distance of that joint from its position at the beginning of the stance [m]."""
    shortest_s: float = 0.1
    """Shortest duration of a stance [s]."""


STANCE_DEFAULTS = StanceSettings()
"""Default settings of the detection of stances."""


class LegJoints(NamedTuple):
    """The joint centres of a leg in K frames, in a scene's unit."""

    hip: Floats
    """(K, 3) centre of the hip."""
    knee: Floats
    """(K, 3) centre of the knee."""
    ankle: Floats
    """(K, 3) centre of the ankle."""
    hinge: Floats
    """(K, 3) axis of the knee, pointing to the left, about which straight legs bend."""


def standing(time: Floats, path: Floats, ground: float, settings: StanceSettings = STANCE_DEFAULTS) -> list[slice]:
    """Find the stances of a foot.

    Args:
        time: (K,) times [s].
        path: (K, 3) path of the supporting joint, Z up [m].
        ground: Height of that joint in a planted foot [m].
        settings: What counts as a stance.

    Returns:
        Ranges of frames in order. A foot that moves away slowly begins a new stance.
    """
    if len(time) < 3:
        return []
    step = float(np.median(np.diff(time)))
    speed = np.linalg.norm(np.gradient(path, time, axis=0), axis=1)
    low: Mask = (speed < settings.largest_speed) & (path[:, 2] < ground + settings.largest_height_m)
    found, first = [], 0
    for k in range(1, len(time) + 1):
        continues = (
            k < len(time) and low[k] and low[k - 1] and time[k] - time[k - 1] < _GAP_RATIO * step
            and np.linalg.norm(path[k] - path[first]) < settings.largest_shift_m
        )  # fmt: skip
        if not continues:
            if low[first] and time[k - 1] - time[first] > settings.shortest_s:
                found.append(slice(first, k))
            first = k
    return found


def planted_feet(path: Floats, stands: list[slice]) -> Floats:
    """Compute the shift of a foot that keeps it in place during its stances.

    Args:
        path: (K, 3) path of the supporting joint of the character's foot.
        stands: Stances of the foot, from `standing`.

    Returns:
        (K, 3) shift to the median position of each stance, with a smooth transition between stances.
    """
    shift = np.zeros(path.shape)
    for rows in stands:
        shift[rows] = np.median(path[rows], axis=0) - path[rows]
    for before, after in zip([None, *stands], [*stands, None], strict=True):
        start = shift[before.stop - 1] if before is not None else None
        end = shift[after.start] if after is not None else None
        rows = slice(before.stop if before is not None else 0, after.start if after is not None else len(path))
        count = rows.stop - rows.start
        share = (np.arange(count)[:, None] + 1) / (count + 1)
        share = share * share * (3 - 2 * share)
        first, last = (start if start is not None else end), (end if end is not None else start)
        if first is not None and last is not None:
            shift[rows] = (1 - share) * first + share * last
    return shift


def leg_rotations(leg: LegJoints, shift: Floats) -> tuple[Floats, Floats]:
    """Compute the rotations of thigh and shank that shift the ankle.

    Args:
        leg: The leg before the shift.
        shift: (K, 3) wanted shift of the ankle; positions out of reach are approached as far as possible.

    Returns:
        Rotations of thigh and shank in the scene, each (K, 3, 3), to be applied after the present ones.
    """
    thigh, shank, wanted = leg.knee - leg.hip, leg.ankle - leg.knee, leg.ankle + shift - leg.hip
    upper, lower, far = (np.linalg.norm(v, axis=1) for v in (thigh, shank, wanted))
    far = np.clip(far, _SMALLEST_EXTENSION * np.abs(upper - lower), _LARGEST_EXTENSION * (upper + lower))
    bend = np.arccos(np.clip((far**2 - upper**2 - lower**2) / (2 * upper * lower), -1, 1))
    is_now = np.arctan2(np.linalg.norm(np.cross(thigh, shank), axis=1), np.sum(thigh * shank, axis=1))
    axis = np.cross(thigh, shank) + 1e-3 * (upper * lower)[:, None] * leg.hinge
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    knee = rotations.about(axis, bend - is_now)
    reached = thigh + np.einsum("kab,kb->ka", knee, shank)
    hip = rotations.shortest(reached, wanted)
    return hip, hip @ knee
