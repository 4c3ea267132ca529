"""Closed outlines in a slice: what they enclose, and where the edge beside them truly lies."""

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask

_SMOOTHING = 2.0
"""Of an outline along itself, in points: standard deviation."""
_REACH = 1.5
_NEAR = 1.0
"""Places along the normal count within the reach, by a Gaussian of this deviation [px]."""
_STEP = 0.1
_SHARPNESS = 4
_EDGE_BLUR = 0.7
_CROSSING = 1.0
"""The image is read so much farther out [px], for differences at the reach's ends."""


def filled(outline: Floats, shape: tuple[int, int]) -> Mask:
    """(rows, columns) true of the pixels whose centres a closed outline goes round, either way about.

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
    # Each crossing to the left of a pixel in its row is once round, this way about or that.
    winding = np.zeros((shape[0], shape[1] + 1), np.int64)
    seen = (row >= 0) & (row < shape[0])
    np.add.at(winding, (row[seen], np.clip(column[seen], 0, shape[1])), np.where(y1 > y0, 1, -1)[seen])
    return np.asarray(np.cumsum(winding, axis=1)[:, :-1] != 0)


def edge_image(image: Floats) -> Floats:
    """Smooth a slice as `on_the_edge` wants it."""
    return np.asarray(ndimage.gaussian_filter(np.asarray(image, float), _EDGE_BLUR))


def on_the_edge(outline: Floats, image: Floats) -> Floats:
    """Take the steps of pixels out of an outline, and move it, by 1.5 pixels at most, to where the image is steepest.

    Ours: places along the normal weigh by the steepness to the power `_SHARPNESS`, near ones more; shifts are smoothed
    along the outline, so that noise does not bend it.

    Args:
        outline: (N, 2) x and y of a wire's corners [px].
        image: (rows, columns) the slice, as `edge_image` gives it.

    Returns:
        (N, 2); what lies on the slice's border stays there.
    """
    size = np.array(image.shape)[::-1]
    smooth = _smoothed(outline, _SMOOTHING)
    along = _smoothed(np.roll(smooth, -1, axis=0) - np.roll(smooth, 1, axis=0), _SMOOTHING)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.divide(along[:, ::-1] * [1, -1], length, out=np.zeros_like(along), where=length > 0)
    shifts = np.arange(-_REACH - _CROSSING, _REACH + _CROSSING + _STEP / 2, _STEP)
    places = smooth[:, None] + shifts[:, None] * normal[:, None]
    profile = ndimage.map_coordinates(image, places.reshape(-1, 2).T[::-1], order=1, mode="nearest")
    steepness = np.abs(np.gradient(profile.reshape(len(outline), -1), axis=1))
    near = np.where(np.abs(shifts) <= _REACH, np.exp(-0.5 * (shifts / _NEAR) ** 2), 0)
    weight = steepness**_SHARPNESS * near
    total = weight.sum(axis=1)
    shift = np.divide(weight @ shifts, total, out=np.zeros_like(total), where=total > 0)
    moved = smooth + _smoothed(shift[:, None], _SMOOTHING) * normal
    border = ((outline <= -0.5) | (outline >= size - 0.5)).any(axis=1, keepdims=True)
    return np.where(border, outline, np.clip(moved, -0.5, size - 0.5))


def _smoothed(values: Floats, deviation: float) -> Floats:
    return np.asarray(ndimage.gaussian_filter1d(values, deviation, axis=0, mode="wrap"))
