"""Colour maps of a knee: outlines by structure, cartilage thickness, and distance between cartilages."""

import numpy as np

from marey.arrays import Floats, Image

FULL_MM = 4.0
"""Thickness at the end of the colour scale [mm]. Chosen by hand."""
STRUCTURE_COLOURS = {
    "femur": "#ffb454", "femoral_cartilage": "#7fd962", "tibia": "#59c2ff", "tibial_cartilage": "#f07bd8",
    "patella": "#ff6b6b", "patellar_cartilage": "#d2a6ff",
}  # fmt: skip
"""Colours of outlines on grey slices by structure, as #rrggbb. Chosen by eye."""
BARE = (226, 216, 200)
"""Colour of bone without cartilage: red, green, blue. Chosen by eye."""
STOPS = np.array([[38, 60, 150], [40, 140, 190], [90, 190, 120], [240, 215, 80], [215, 60, 45]], float)
"""(5, 3) Colours at equal steps of the scale, from blue (thin, far) to red (thick, near): red, green, blue.

Chosen by eye."""


def thickness_colours(thickness_mm: Floats, full_mm: float = FULL_MM) -> Image:
    """Return the colours (..., 3) in red, green, blue of thicknesses (...) [mm]; 0 and NaN are drawn as bare bone."""
    known = np.nan_to_num(np.asarray(thickness_mm, float))
    place = np.clip(known / full_mm, 0, 1) * (len(STOPS) - 1)
    colours = np.stack([np.interp(place, np.arange(len(STOPS)), STOPS[:, channel]) for channel in range(3)], -1)
    return np.where((known > 0)[..., None], np.round(colours), BARE).astype(np.uint8)


OVERLAP = (110, 30, 130)
"""Colour of overlapping cartilage, violet: red, green, blue. Chosen by eye."""
FAR = (212, 224, 230)
"""Colour of cartilage beyond the limit of the distance: red, green, blue. Chosen by eye."""
BONE = (232, 222, 203)
"""Colour of bones: red, green, blue. Chosen by eye."""


def proximity_colours(distance_mm: Floats, limit_mm: float) -> Image:
    """Return the colours (..., 3) in red, green, blue of distances (...) [mm].

    Red is 0, blue the limit, and violet an overlap (a negative distance).
    """
    distance = np.asarray(distance_mm, float)
    near = np.nan_to_num(distance, nan=np.inf) < limit_mm
    place = np.clip(1 - np.where(near, distance, 0) / limit_mm, 0, 1) * (len(STOPS) - 1)
    colours = np.stack([np.interp(place, np.arange(len(STOPS)), STOPS[:, channel]) for channel in range(3)], -1)
    shown = np.where(near[..., None], np.round(colours), FAR)
    return np.where((near & (distance < 0))[..., None], OVERLAP, shown).astype(np.uint8)
