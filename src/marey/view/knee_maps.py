"""Cartilage thickness in colours: blue thin, green, yellow and red thick, bone colour where it is bare."""

import numpy as np

from marey.arrays import Floats, Image

FULL_MM = 4.0
"""Thickness at the end of the scale."""
BARE = (226, 216, 200)
_STOPS = np.array([[38, 60, 150], [40, 140, 190], [90, 190, 120], [240, 215, 80], [215, 60, 45]], float)


def thickness_colours(thickness_mm: Floats, full_mm: float = FULL_MM) -> Image:
    """Give red, green and blue (..., 3) of thicknesses (...) [mm]; 0 and NaN are bare."""
    known = np.nan_to_num(np.asarray(thickness_mm, float))
    place = np.clip(known / full_mm, 0, 1) * (len(_STOPS) - 1)
    colours = np.stack([np.interp(place, np.arange(len(_STOPS)), _STOPS[:, channel]) for channel in range(3)], -1)
    return np.where((known > 0)[..., None], np.round(colours), BARE).astype(np.uint8)
