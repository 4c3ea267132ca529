"""Twists, the velocities of rigid motions."""

import numpy as np

from marey.arrays import Floats


def about_axis(point: Floats, axis: Floats) -> Floats:
    """Return the twist (v, w) of a revolute joint, a screw of zero pitch ([Rosenhahn2006] section 2.3).

    Args:
        point: (..., 3) any point on the axis [m].
        axis: (..., 3) unit direction.

    Returns:
        (..., 6): v = point x axis, then w = axis.
    """
    return np.concatenate([np.cross(point, axis), np.broadcast_to(axis, np.shape(point))], -1)
