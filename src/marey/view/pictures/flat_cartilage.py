"""Flat map of the thickness of a cartilage; that of the femur is unrolled."""

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from marey.arrays import Floats, Image
from marey.view.pictures.knee_maps import FULL_MM, thickness_colours

_PX_PER_MM = 6
"""Resolution of the map [px/mm]. Chosen by eye."""
_MARGIN_PX, _SCALE_PX = 40, 90
"""Margin on each side, and width of the colour scale [px]. Chosen by eye."""
_REACH_MM = 2.5
"""Pixels farther than this distance from all vertices are not coloured [mm]. Chosen by eye."""
_INK = (60, 60, 60)
"""Colour of the texts: blue, green, red. Chosen by eye."""


def flat_picture(across_mm: Floats, along_mm: Floats, thickness_mm: Floats, *, full_mm: float = FULL_MM) -> Image:
    """Draw a flat map of the thickness with its colour scale; lateral is on the right, anterior at the top.

    Args:
        across_mm: (V,) position from left to right on the map [mm].
        along_mm: (V,) position from top to bottom on the map [mm].
        thickness_mm: (V,) thickness [mm]; vertices with 0 are bare and not drawn.
        full_mm: Thickness at the end of the colour scale [mm].

    Returns:
        (height, width, 3) blue, green, red; uint8.
    """
    covered = thickness_mm > 0
    places = np.stack([across_mm, along_mm], 1)[covered]
    low, high = places.min(0) - 2, places.max(0) + 2
    width, height = np.ceil((high - low) * _PX_PER_MM).astype(int)
    x, y = np.meshgrid(low[0] + np.arange(width) / _PX_PER_MM, low[1] + np.arange(height) / _PX_PER_MM)
    values = LinearNDInterpolator(places, thickness_mm[covered])(x, y)
    away = cKDTree(places).query(np.stack([x, y], -1), distance_upper_bound=_REACH_MM)[0]
    shown = np.where(np.isfinite(away), np.nan_to_num(values), 0.0)
    map_colours = np.where((shown > 0)[..., None], thickness_colours(shown, full_mm)[..., ::-1], 255)
    picture = np.full((height + 2 * _MARGIN_PX, width + 2 * _MARGIN_PX + _SCALE_PX, 3), 255, np.uint8)
    picture[_MARGIN_PX : _MARGIN_PX + height, _MARGIN_PX : _MARGIN_PX + width] = map_colours
    _draw_scale(picture, _MARGIN_PX + width + 20, full_mm)
    for text, place in (
        ("medial", (_MARGIN_PX, height + _MARGIN_PX + 24)),
        ("lateral", (_MARGIN_PX + width - 50, height + _MARGIN_PX + 24)),
    ):
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return picture


def _draw_scale(picture: Image, left: int, full_mm: float) -> None:
    rows = picture.shape[0] - 2 * _MARGIN_PX
    bar = thickness_colours(np.linspace(full_mm, 1e-6, rows), full_mm)[:, None, ::-1]
    picture[_MARGIN_PX : _MARGIN_PX + rows, left : left + 16] = bar
    for mm in range(int(full_mm) + 1):
        row = _MARGIN_PX + int((1 - mm / full_mm) * (rows - 1))
        text = f"{mm} mm"
        cv2.putText(picture, text, (left + 20, row + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
