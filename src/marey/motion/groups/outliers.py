"""Values that are far from the others of their group, by robust deviations ([Iglewicz1993])."""

import numpy as np

from marey.arrays import Floats, Mask

FEWEST_FOR_OUTLIERS = 5
"""Number of values from which on outliers are marked; of fewer, the median deviation says little. Chosen by hand."""
_FARTHEST = 3.5
"""Robust deviation, in standard deviations, above which a value is an outlier ([Iglewicz1993])."""
_SD_OF_MEDIAN_DEVIATION = 1.4826
"""Standard deviation of a normal distribution whose median absolute deviation is 1."""


def find_outliers(values: Floats, sds: Floats) -> Mask:
    """Find values whose distance from the median is not explained by the spread of the group and their own uncertainty.

    Args:
        values: (N,) values; NaN is never an outlier.
        sds: (N,) their standard deviations; an unknown one counts as zero.

    Returns:
        (N,) true for outliers; all false in a small group.
    """
    known = np.isfinite(values)
    if known.sum() < FEWEST_FOR_OUTLIERS:
        return np.zeros(len(values), bool)
    distance = np.abs(values - np.median(values[known]))
    spread = _SD_OF_MEDIAN_DEVIATION * np.median(distance[known])
    own = np.where(np.isfinite(sds), sds, 0.0)
    scale = np.hypot(spread, own)
    return np.asarray(known & (distance > _FARTHEST * scale) & (distance > 0))
