"""Twist: the part of a limb's rotation about its own axis, distributed over the joints of a rig."""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations


def twist_angles(relative: Floats, axis: Floats) -> Floats:
    """Compute the twist of rotations about an axis, relative to the shortest rotation with the same final axis.

    Args:
        relative: (K, 3, 3) rotations of a segment relative to its parent in successive frames.
        axis: (3,) axis of the segment at rest, of any length.

    Returns:
        (K,) continuous angles [rad]; undetermined where the axis is opposite to its direction at rest.
    """
    quaternion = rotations.to_quaternion(relative)
    along = quaternion[:, 1:] @ (axis / np.linalg.norm(axis))
    angles = 2 * np.arctan2(along, quaternion[:, 0])
    return np.asarray(np.unwrap((angles + np.pi) % (2 * np.pi) - np.pi))


def reduce_twist(parent: Floats, segment: Floats, axis: Floats, share: float) -> Floats:
    """Reduce the twist of a segment's rotations to a share of it.

    Args:
        parent: (K, 3, 3) rotations of the parent segment in the world, from rest.
        segment: (K, 3, 3) the same of the segment.
        axis: (3,) along the segment at rest.
        share: Share of the twist that is kept: 0 for the parent's orientation about the axis, 1 for the segment's.

    Returns:
        (K, 3, 3) rotations in the world.
    """
    direction = axis / np.linalg.norm(axis)
    angles = twist_angles(np.swapaxes(parent, 1, 2) @ segment, direction)
    return np.asarray(segment @ rotations.about(direction, (share - 1.0) * angles))
