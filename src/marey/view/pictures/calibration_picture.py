"""Pictures of a calibration: the corners in an image with their residuals, and the accuracy in the capture volume."""

import cv2
import numpy as np

from marey.arrays import Floats, Image

_WIDTH = 640
"""Width of the pictures [px]; chosen by hand."""
_ENLARGED = 400.0
"""Most times that residuals are enlarged; chosen by hand."""
_SHOWN_PX = 12.0
"""Length of a typical large residual in the picture [px]; chosen by hand."""
_PAPER, _INK, _CELL = (250, 248, 246), (120, 105, 90), (238, 230, 220)
"""Colours of ground, text and covered cells: blue, green, red. Chosen by eye."""
_RESIDUAL = (63, 69, 192)
"""Colour of residuals: blue, green, red. Chosen by eye."""
_PIXELS_PER_POINT = 56
"""Side of a point's square in the picture of the volume [px]; chosen by hand."""


def coverage_picture(pixels: Floats, residual: Floats, size: tuple[int, int], cells: tuple[int, int]) -> Image:
    """Draw the corners of a camera over its image plane, with covered cells and enlarged residuals.

    Args:
        pixels: (n, 2) corners [px].
        residual: (n, 2) measured minus predicted [px].
        size: Width and height of the image [px].
        cells: Rows and columns of the cells.

    Returns:
        (h, w, 3) blue, green, red.
    """
    scale = _WIDTH / size[0]
    height = round(size[1] * scale)
    picture = np.full((height, _WIDTH, 3), _PAPER, np.uint8)
    rows, columns = cells
    counts, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=(rows, columns), range=((0, size[1]), (0, size[0])))
    for row, column in np.argwhere(counts > 0):
        x, y = np.array([column, column + 1]) * _WIDTH // columns, np.array([row, row + 1]) * height // rows
        cv2.rectangle(picture, (int(x[0]), int(y[0])), (int(x[1]) - 1, int(y[1]) - 1), _CELL, -1)
    length = np.linalg.norm(residual, axis=1)
    typical = float(np.percentile(length, 95)) if len(length) else 1.0
    enlarged = min(_SHOWN_PX / max(typical * scale, 1e-6), _ENLARGED)
    start, end = pixels * scale, (pixels + enlarged * residual) * scale
    for a, b in zip(start, np.clip(end, -1e4, 1e4), strict=True):
        cv2.line(picture, _place(a), _place(b), _RESIDUAL, 1, cv2.LINE_AA, 4)
    for a in start:
        cv2.circle(picture, _place(a), 18, _INK, -1, cv2.LINE_AA, 4)
    cv2.putText(
        picture, f"residuals x {enlarged:.0f}", (8, height - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA
    )
    return picture


def _place(point: Floats) -> tuple[int, int]:
    return round(float(point[0]) * 16), round(float(point[1]) * 16)


def volume_picture(points: Floats, sd_mm: Floats, height: float) -> Image:
    """Draw the predicted standard deviations of a layer of the capture volume, seen from above.

    Args:
        points: (n, 3) of a grid [m].
        sd_mm: (n,) standard deviations [mm]; NaN where a point is not determined.
        height: Height of the layer; the nearest one of the grid is drawn [m].

    Returns:
        (h, w, 3) blue, green, red; grey where two cameras do not see the point.
    """
    levels = np.unique(points[:, 2])
    layer = points[:, 2] == levels[np.argmin(np.abs(levels - height))]
    x, y = np.unique(points[layer, 0]), np.unique(points[layer, 1])
    column, row = np.searchsorted(x, points[layer, 0]), len(y) - 1 - np.searchsorted(y, points[layer, 1])
    side = _PIXELS_PER_POINT
    picture = np.full((side * len(y), side * len(x), 3), (225, 225, 225), np.uint8)
    known = sd_mm[np.isfinite(sd_mm)]
    low, high = np.percentile(known, [5, 95]) if len(known) else (0.0, 1.0)
    for c, r, value in zip(column, row, sd_mm[layer], strict=True):
        if np.isnan(value):
            continue
        share = np.clip((value - low) / max(high - low, 1e-9), 0, 1)
        level = np.full((1, 1), round(255 * (0.15 + 0.7 * share)), np.uint8)
        colour = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS))[0, 0]
        corner = (int(c) * side, int(r) * side)
        cv2.rectangle(picture, corner, (corner[0] + side - 1, corner[1] + side - 1), colour.tolist(), -1)
        text = f"{value:.2f}" if value < 9.995 else f"{value:.0f}"
        ink = (255, 255, 255) if share < 0.6 else (20, 20, 20)
        cv2.putText(
            picture,
            text,
            (corner[0] + 6, corner[1] + side // 2 + 5),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.45,
            ink,
            1,
            cv2.LINE_AA,
        )
    return picture
