"""Closed outlines in a slice: their interior, and the position of the edge near them."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask


@dataclass(frozen=True, kw_only=True)
class EdgeSnapSettings:
    """Settings for moving an outline to the steepest edge.

    Values without a stated source were chosen by hand.
    """

    smoothing: float = 2.0
    """Standard deviation, in points, of the smoothing along the outline."""
    reach_px: float = 1.5
    """Largest distance [px] by which an outline moves."""
    near_px: float = 1.0
    """Standard deviation [px] of the Gaussian weight of positions along the normal."""
    step_px: float = 0.1
    """Spacing [px] of these positions."""
    sharpness: int = 4
    """Exponent of the steepness in the weight of a position."""
    blur_px: float = 0.7
    """Standard deviation [px] of the smoothing of the image."""
    margin_px: float = 1.0
    """Distance [px] beyond the reach at which the image is read as well, for differences at its ends."""


EDGE_SNAP_DEFAULTS = EdgeSnapSettings()
"""Default settings for moving an outline to the steepest edge."""


def filled(outline: Floats, shape: tuple[int, int]) -> Mask:
    """Return the mask (rows, columns) of the pixels whose centres a closed outline of either orientation encloses.

    Args:
        outline: (N, 2) x and y in pixels.
        shape: Rows and columns.
    """
    start, end = outline, np.roll(outline, -1, axis=0)
    first = np.ceil(np.minimum(start[:, 1], end[:, 1])).astype(int)
    count = np.ceil(np.maximum(start[:, 1], end[:, 1])).astype(int) - first
    piece = np.repeat(np.arange(len(outline)), count)
    row = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + first[piece]
    x0, y0 = start[piece].T
    x1, y1 = end[piece].T
    column = np.floor(x0 + (row - y0) / (y1 - y0) * (x1 - x0)).astype(int) + 1
    # Each crossing to the left of a pixel in its row changes its winding number by one.
    winding = np.zeros((shape[0], shape[1] + 1), np.int64)
    seen = (row >= 0) & (row < shape[0])
    np.add.at(winding, (row[seen], np.clip(column[seen], 0, shape[1])), np.where(y1 > y0, 1, -1)[seen])
    return np.asarray(np.cumsum(winding, axis=1)[:, :-1] != 0)


def edge_image(image: Floats, *, settings: EdgeSnapSettings = EDGE_SNAP_DEFAULTS) -> Floats:
    """Smooth a slice as `on_the_edge` expects it."""
    return np.asarray(ndimage.gaussian_filter(np.asarray(image, float), settings.blur_px))


def on_the_edge(outline: Floats, image: Floats, *, settings: EdgeSnapSettings = EDGE_SNAP_DEFAULTS) -> Floats:
    """Smooth the steps of pixels in an outline, and move it, by at most 1.5 pixels, to where the image is steepest.

    Positions along the normal are weighted by the steepness to the power `sharpness`, and by a Gaussian of their
    distance; shifts are smoothed along the outline against noise. The method is our own.

    Args:
        outline: (N, 2) x and y of a wire's corners [px].
        image: (rows, columns) the slice, as `edge_image` gives it.
        settings: Tuned constants of the algorithm.

    Returns:
        (N, 2); points on the slice's border are kept.
    """
    size = np.array(image.shape)[::-1]
    smooth = _smoothed(outline, settings.smoothing)
    along = _smoothed(np.roll(smooth, -1, axis=0) - np.roll(smooth, 1, axis=0), settings.smoothing)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.divide(along[:, ::-1] * [1, -1], length, out=np.zeros_like(along), where=length > 0)
    shifts = np.arange(
        -settings.reach_px - settings.margin_px,
        settings.reach_px + settings.margin_px + settings.step_px / 2,
        settings.step_px,
    )
    places = smooth[:, None] + shifts[:, None] * normal[:, None]
    profile = ndimage.map_coordinates(image, places.reshape(-1, 2).T[::-1], order=1, mode="nearest")
    steepness = np.abs(np.gradient(profile.reshape(len(outline), -1), axis=1))
    near = np.where(np.abs(shifts) <= settings.reach_px, np.exp(-0.5 * (shifts / settings.near_px) ** 2), 0)
    weight = steepness**settings.sharpness * near
    total = weight.sum(axis=1)
    shift = np.divide(weight @ shifts, total, out=np.zeros_like(total), where=total > 0)
    moved = smooth + _smoothed(shift[:, None], settings.smoothing) * normal
    border = ((outline <= -0.5) | (outline >= size - 0.5)).any(axis=1, keepdims=True)
    return np.where(border, outline, np.clip(moved, -0.5, size - 0.5))


def _smoothed(values: Floats, deviation: float) -> Floats:
    return np.asarray(ndimage.gaussian_filter1d(values, deviation, axis=0, mode="wrap"))
