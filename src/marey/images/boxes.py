"""The part of an image about a region, for work whose result depends on the neighbourhood of the region only."""

import numpy as np

from marey.arrays import Mask

Box = tuple[slice, slice]
"""Rows and columns of a part of an image."""


def box_about(region: Mask, margin: float) -> Box:
    """Return the smallest part of an image that contains a region and a margin about it.

    Args:
        region: (H, W) true inside; not empty.
        margin: Least distance between the region and the border of the part [px]; at the image's border there is less.

    Returns:
        Rows and columns of the part.
    """
    wide = int(np.ceil(margin))
    rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
    return (
        slice(int(max(rows[0] - wide, 0)), int(rows[-1]) + wide + 1),
        slice(int(max(columns[0] - wide, 0)), int(columns[-1]) + wide + 1),
    )
