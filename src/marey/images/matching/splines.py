"""Cubic splines through grey images, with values and gradients at any position between the pixels."""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.compiled.kernel_copies import copy_row
from marey.compiled.kernels import kernel
from marey.errors import SettingProblem

POLE = np.sqrt(3.0) - 2.0
"""Factor by which a pixel's influence on the coefficients decays from one pixel to the next [Unser1999]."""
_HORIZON = 16
"""Distance after which this influence is negligible, 2e-9 [px]."""
_BLIND = 3
"""Distance from a missing pixel within which coefficients are missing too [px]; beyond, its substitute has a weight
below 2 %."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SplinePicture:
    """A grey image as a sum of cubic B-splines, one per pixel [Unser1999]."""

    coefficients: Floats
    """(H, W) float32 coefficients [grey levels]; NaN about missing pixels."""

    def __post_init__(self) -> None:
        freeze_fields(self, "coefficients", dtype=np.float32)


def spline_of(image: np.ndarray) -> SplinePicture:
    """Interpolate an image's grey values by a cubic spline; beyond the border the image is mirrored.

    Args:
        image: (H, W) grey, uint8 or float, at least 2 pixels wide and high. NaN where unknown, or not to be used.

    Returns:
        The spline, which has the image's values at the pixel centres.

    Raises:
        SettingProblem: The image is not grey.
    """
    if image.ndim != 2 or min(image.shape) < 2 or image.dtype.kind not in "uif":
        raise SettingProblem(f"A grey image has the shape (height, width), not {image.shape} ({image.dtype}).")
    values = np.array(image, dtype=np.float32, order="C")
    missing = ~np.isfinite(values)
    if missing.any():
        values = _filled(values, missing)
    _filter_rows(values)
    _filter_columns(values)
    if missing.any():
        size = 2 * _BLIND + 1
        values[cv2.dilate(missing.view(np.uint8), np.ones((size, size), np.uint8)) > 0] = np.nan
    return SplinePicture(coefficients=values)


def weights(t: Floats) -> Floats:
    """Return the values (..., 4) of the four B-splines at a fraction t (...) of a pixel after the second one."""
    s = 1 - t
    return np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=-1) / 6


def slopes(t: Floats) -> Floats:
    """Return the derivatives (..., 4) of `weights`."""
    s = 1 - t
    return np.stack([-(s**2), 3 * t**2 - 4 * t, -3 * s**2 + 4 * s, t**2], axis=-1) / 2


def _filled(values: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Replace each missing value by the nearest known one."""
    if missing.all():
        return np.zeros_like(values)
    kind = cv2.DIST_LABEL_PIXEL
    _, label = cv2.distanceTransformWithLabels(missing.view(np.uint8), cv2.DIST_L2, 5, labelType=kind)
    known = np.empty(label.max() + 1, np.float32)
    known[label[~missing]] = values[~missing]
    return np.asarray(known[label])


@kernel
def _filter_rows(values):
    """Convert grey values to coefficients along the rows, in place, by a recursive filter forward and backward."""
    height, width = values.shape
    pole = np.float32(POLE)
    for y in range(height):
        line = values[y]
        first, power = np.float32(0.0), np.float32(1.0)
        for k in range(_HORIZON):
            at = k % (2 * width - 2)
            first += power * line[min(at, 2 * width - 2 - at)]
            power *= pole
        line[0] = np.float32(6.0) * first
        for x in range(1, width):
            line[x] = np.float32(6.0) * line[x] + pole * line[x - 1]
        line[width - 1] = pole / (pole * pole - np.float32(1.0)) * (line[width - 1] + pole * line[width - 2])
        for x in range(width - 2, -1, -1):
            line[x] = pole * (line[x + 1] - line[x])


@kernel
def _filter_columns(values):
    """Do the same along the columns, one row at a time, so that the compiler vectorises the loops."""
    height, width = values.shape
    pole = np.float32(POLE)
    first, power = np.zeros(width, np.float32), np.float32(1.0)
    for k in range(_HORIZON):
        at = k % (2 * height - 2)
        line = values[min(at, 2 * height - 2 - at)]
        for x in range(width):
            first[x] += power * line[x]
        power *= pole
    copy_row(values[0], np.float32(6.0) * first)
    for y in range(1, height):
        line, before = values[y], values[y - 1]
        for x in range(width):
            line[x] = np.float32(6.0) * line[x] + pole * before[x]
    last, before = values[height - 1], values[height - 2]
    for x in range(width):
        last[x] = pole / (pole * pole - np.float32(1.0)) * (last[x] + pole * before[x])
    for y in range(height - 2, -1, -1):
        line, after = values[y], values[y + 1]
        for x in range(width):
            line[x] = pole * (after[x] - line[x])
