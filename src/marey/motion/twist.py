"""Twist: the part of a limb's turn that goes about its own axis, shared along the joints a rig has for it."""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations


def twist_angles(relative: Floats, axis: Floats) -> Floats:
    """Measure how far turns go about an axis, after the shortest turn that brings the axis where they bring it.

    Args:
        relative: (K, 3, 3) turns of a segment on its parent, frame after frame.
        axis: (3,) of the segment at rest, of any length.

    Returns:
        (K,) without jumps [rad]. Where the axis comes to lie opposite to its rest nobody can tell.
    """
    quaternion = rotations.to_quaternion(relative)
    along = quaternion[:, 1:] @ (axis / np.linalg.norm(axis))
    angles = 2 * np.arctan2(along, quaternion[:, 0])
    return np.asarray(np.unwrap((angles + np.pi) % (2 * np.pi) - np.pi))


def reduce_twist(parent: Floats, segment: Floats, axis: Floats, share: float) -> Floats:
    """Take from a segment's turns all but a share of their twist.

    Args:
        parent: (K, 3, 3) rotations of the parent segment in the world, from rest.
        segment: (K, 3, 3) likewise of the segment.
        axis: (3,) along the segment at rest.
        share: Of the twist that is kept: 0 as the parent leaves it, 1 as the segment turns.

    Returns:
        (K, 3, 3) in the world.
    """
    direction = axis / np.linalg.norm(axis)
    angles = twist_angles(np.swapaxes(parent, 1, 2) @ segment, direction)
    return np.asarray(segment @ rotations.about(direction, (share - 1.0) * angles))
