"""Feet that stand still: found in a motion, and kept in their place on a character whose legs are others."""

from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations

SLOW = 0.3
"""A foot stands while the joint on which it does moves slower [m/s], ..."""
NEAR_GROUND = 0.06
"""... is not higher above the ground [m], ..."""
STILL = 0.03
"""... stays within this distance of where it came to stand [m], ..."""
LASTING = 0.1
"""... and all that for longer [s]."""
_STRAIGHT = 0.999
"""A leg is stretched no further than to this share of its length: a straight one has no side to bend to."""


class LegJoints(NamedTuple):
    """The joint centres of a leg in K frames, in a scene."""

    hip: Floats
    """(K, 3)."""
    knee: Floats
    """(K, 3)."""
    ankle: Floats
    """(K, 3)."""
    hinge: Floats
    """(K, 3) the knee's axis, to the left: about which straight legs bend."""


def standing(time: Floats, path: Floats, ground: float) -> list[slice]:
    """Find when a foot stands still.

    Args:
        time: (K,) [s].
        path: (K, 3) of the joint on which it stands, Z up [m].
        ground: Height of that joint in a foot that stands [m].

    Returns:
        Stretches of frames, one behind the other. A foot that comes to stand elsewhere, or creeps on, begins a new one.
    """
    if len(time) < 3:
        return []
    step = float(np.median(np.diff(time)))
    speed = np.linalg.norm(np.gradient(path, time, axis=0), axis=1)
    low: Mask = (speed < SLOW) & (path[:, 2] < ground + NEAR_GROUND)
    found, first = [], 0
    for k in range(1, len(time) + 1):
        goes_on = (
            k < len(time) and low[k] and low[k - 1] and time[k] - time[k - 1] < 1.5 * step
            and np.linalg.norm(path[k] - path[first]) < STILL
        )  # fmt: skip
        if not goes_on:
            if low[first] and time[k - 1] - time[first] > LASTING:
                found.append(slice(first, k))
            first = k
    return found


def planted_feet(path: Floats, stands: list[slice]) -> Floats:
    """Say by how much a foot must be shifted to stand still when it should.

    Args:
        path: (K, 3) of the joint on which the character's foot stands.
        stands: When it should stand, see `standing`.

    Returns:
        (K, 3): to the middle of where it stands; between two stands the shift goes smoothly from one to the next.
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
    """Bend a leg at the knee and turn it about the hip, so that its ankle is shifted.

    Args:
        leg: As it is.
        shift: (K, 3) of the ankle. What is out of the leg's reach is come near to.

    Returns:
        By how much thigh and shank are turned in the scene, each (K, 3, 3), after what they do already.
    """
    thigh, shank, wanted = leg.knee - leg.hip, leg.ankle - leg.knee, leg.ankle + shift - leg.hip
    upper, lower, far = (np.linalg.norm(v, axis=1) for v in (thigh, shank, wanted))
    far = np.clip(far, 1.001 * np.abs(upper - lower), _STRAIGHT * (upper + lower))
    bend = np.arccos(np.clip((far**2 - upper**2 - lower**2) / (2 * upper * lower), -1, 1))
    is_now = np.arctan2(np.linalg.norm(np.cross(thigh, shank), axis=1), np.sum(thigh * shank, axis=1))
    axis = np.cross(thigh, shank) + 1e-3 * (upper * lower)[:, None] * leg.hinge
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    knee = rotations.about(axis, bend - is_now)
    reached = thigh + np.einsum("kab,kb->ka", knee, shank)
    hip = rotations.shortest(reached, wanted)
    return hip, hip @ knee
