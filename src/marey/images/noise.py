"""Estimation of an image's noise from the image itself."""

import cv2
import numpy as np

from marey.arrays import Floats

_HIGH_PASS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
"""Filter that removes what is linear in x or in y and keeps the standard deviation of white noise [Immerkaer1996]."""
_BLOCK = 16
"""Width and height of the blocks in which the noise is measured [px]. Chosen by hand."""
_QUIET = 0.2
"""Share of the blocks that contain noise but no texture. Chosen by hand."""
ROUNDING = 12**-0.5
"""Standard deviation of the rounding to whole grey levels."""


def noise_of(image: np.ndarray) -> float:
    """Estimate the standard deviation of a pixel's noise [grey levels].

    Args:
        image: (H, W) grey, in whole levels.

    Returns:
        The noise in the image's quieter blocks, because texture resembles noise in the others; at least the rounding
        error. In compressed images the estimate is too small.
    """
    height, width = (side // _BLOCK * _BLOCK for side in image.shape)
    if min(height, width) == 0:
        return ROUNDING
    passed = cv2.filter2D(image.astype(np.float32), -1, _HIGH_PASS)[:height, :width]
    spread = _blocks(np.abs(passed)).mean(axis=1) * np.sqrt(np.pi / 2)
    # Saturated blocks contain no visible noise and are excluded.
    alive = spread > 0
    return max(float(np.quantile(spread[alive], _QUIET)), ROUNDING) if alive.any() else ROUNDING


def _blocks(values: Floats) -> Floats:
    height, width = values.shape
    cut = values.reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
    return cut.transpose(0, 2, 1, 3).reshape(-1, _BLOCK * _BLOCK)
