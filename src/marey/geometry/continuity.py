"""Angles over time without jumps by whole turns."""

import numpy as np

from marey.arrays import Floats


def continuous_angles(angles: Floats, *, period: float = 2 * np.pi, centred: bool = False) -> Floats:
    """Remove jumps by whole turns from angles over time, also over gaps.

    Args:
        angles: (F,) one angle, or (F, A) several; NaN where unknown.
        period: A whole turn in the unit of the angles, for example 360 for degrees.
        centred: Whether the median of each angle is shifted to within half a turn of zero; otherwise its first known
            value stays.

    Returns:
        The same angles up to whole turns.
    """
    found = np.array(angles, float)
    for column in (found if found.ndim > 1 else found[:, None]).T:
        known = np.isfinite(column)
        if known.any():
            run = np.unwrap(column[known], period=period)
            column[known] = run - period * np.round(np.median(run) / period) if centred else run
    return found
