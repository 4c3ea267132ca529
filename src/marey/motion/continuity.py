"""Angles over time without jumps by whole turns."""

import numpy as np

from marey.arrays import Floats


def continuous_degrees(angles_deg: Floats) -> Floats:
    """Remove jumps by 360 degrees from angles, also over gaps; the median of each stays within 180 degrees.

    Args:
        angles_deg: (F, A) angles [degrees]; NaN where unknown.

    Returns:
        (F, A) the same angles up to multiples of 360 degrees.
    """
    angles = np.array(angles_deg, float)
    for column in angles.T:
        known = np.isfinite(column)
        if known.any():
            run = np.unwrap(column[known], period=360.0)
            column[known] = run - 360.0 * np.round(np.median(run) / 360.0)
    return angles
