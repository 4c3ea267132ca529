"""Drawing of a measured surface: its points over a camera's image, coloured by depth, and the shaded surface."""

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.cameras.camera import Camera
from marey.surface.points.measured import MeasuredPoints

_LAMP_DIRECTION = np.array([-0.7, -0.6, -0.5])
"""Direction to the lamp in the camera's axes: above, left, and towards the camera. Chosen by eye."""
_BRIGHTNESS = 0.45
"""Fraction of the image's brightness under the points. Chosen by eye."""
_CLIPPED_PERCENT = 2.0
"""Percentage of points beyond each end of the colour scale [%]. Chosen by eye."""
_LARGEST_JUMP = 8.0
"""Neighbours farther apart than this multiple of the median spacing are not joined. Chosen by eye."""


def depth_picture(points: MeasuredPoints, camera: Camera, number: int, image: Image) -> Image:
    """Draw the points that a template's camera shows over its image, coloured from red (near) to blue (far).

    Args:
        points: Points of one frame.
        camera: A camera whose image was a template.
        number: Index of the camera.
        image: (H, W, 3) image of the camera.

    Returns:
        (H, W, 3) blue, green, red.
    """
    drawn = np.asarray(image * _BRIGHTNESS, np.uint8)
    shown = np.isfinite(points.pixels[:, number, 0])
    if not (points.template == number).any():
        return drawn
    depth = camera.depths(points.points[shown])
    near, far = np.percentile(depth, [_CLIPPED_PERCENT, 100 - _CLIPPED_PERCENT])
    share = np.clip((far - depth) / max(far - near, 1e-9), 0, 1)
    colour = cv2.applyColorMap(np.asarray(255 * share, np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0]
    radius = max(0, _spacing_of(points, number) // 2)
    for (x, y), paint in zip(np.round(points.pixels[shown, number]).astype(int), colour, strict=True):
        drawn[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1] = paint
    return drawn


def lit_picture(points: MeasuredPoints, camera: Camera, number: int) -> Image:
    """Draw the shaded surface of the points that a template's camera shows.

    Args:
        points: Points of one frame.
        camera: A camera whose image was a template.
        number: Index of the camera.

    Returns:
        (H, W, 3); black where nothing was measured.
    """
    own = points[np.isfinite(points.pixels[:, number, 0])]
    width, height = camera.size
    if not (points.template == number).any():
        return np.zeros((height, width, 3), np.uint8)
    pixels = np.round(own.pixels[:, number]).astype(int)
    spacing = _spacing_of(points, number)
    column, row = ((pixels - pixels.min(axis=0)) // spacing).T
    place = np.full((row.max() + 1, column.max() + 1, 3), np.nan)
    place[row, column] = camera.camera_from_world.apply(own.points)
    shade = _shaded(place)
    grey = np.zeros((height, width), np.uint8)
    x, y = pixels.min(axis=0)
    large = cv2.resize(shade, (shade.shape[1] * spacing, shade.shape[0] * spacing), interpolation=cv2.INTER_NEAREST)
    part = grey[y : y + large.shape[0], x : x + large.shape[1]]
    part[:] = large[: part.shape[0], : part.shape[1]]
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)


def _shaded(place: Floats) -> Image:
    """Return the shading of a grid of positions (R, C, 3) in camera axes; 0 where unknown."""
    right, down = _slope(place, axis=1), _slope(place, axis=0)
    normal = np.cross(down, right)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = np.clip(normal @ (_LAMP_DIRECTION / np.linalg.norm(_LAMP_DIRECTION)), 0, 1)
    known: Mask = np.isfinite(light)
    return np.where(known, 25 + 230 * np.where(known, light, 0), 0).astype(np.uint8)


def _slope(place: Floats, axis: int) -> Floats:
    """Differentiate along an axis, with both neighbours or the only known one."""
    step = np.diff(place, axis=axis)
    usual = np.nanmedian(np.linalg.norm(step, axis=-1)) if np.isfinite(step).any() else 1.0
    step = np.where(np.linalg.norm(step, axis=-1, keepdims=True) > _LARGEST_JUMP * usual, np.nan, step)
    edge = np.full_like(np.take(place, [0], axis=axis), np.nan)
    both = np.stack([np.concatenate([edge, step], axis=axis), np.concatenate([step, edge], axis=axis)])
    known = np.isfinite(both)
    total = np.where(known, both, 0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


def _spacing(pixels: Floats) -> int:
    """Return the spacing of the points [px]."""
    columns = np.unique(np.round(pixels[:, 0]))
    return int(np.median(np.diff(columns))) if len(columns) > 1 else 1


def _spacing_of(points: MeasuredPoints, number: int) -> int:
    """Return the spacing of the points whose template is the image of a camera [px]."""
    return _spacing(points.pixels[points.template == number, number])
