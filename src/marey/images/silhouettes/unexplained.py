"""Texture that an image of the empty room does not explain, which indicates a textured object in front of it."""

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask

_WINDOW = 13
"""Width and height of the windows that are compared [px]. Chosen by hand."""
_LEAST = 5.0
"""Least standard deviation of the residual that neither noise nor compression explains [grey levels]. Chosen by
hand."""


def unexplained_texture(image: Image, empty: Floats) -> Mask:
    """Return where an image's texture is not that of the empty room, independent of brightness.

    About each pixel the grey values are regressed on those of the empty room. A shadow, which only scales them, leaves
    no residual; a speckled surface leaves a large one, even if its mean colour is that of the room.

    Args:
        image: (H, W, 3).
        empty: (H, W, 1 or 3) the empty room in the same camera.

    Returns:
        (H, W) true in such regions, which are eroded by half a window, because windows at their borders contain the
        room too.
    """
    now, before = (np.asarray(each, np.float32).mean(axis=-1) for each in (image, empty))
    mean_now, mean_before = _mean(now), _mean(before)
    variance = _mean(before * before) - mean_before**2
    both = _mean(now * before) - mean_now * mean_before
    left = _mean(now * now) - mean_now**2 - both**2 / np.maximum(variance, 1e-3)
    strange = (left > _LEAST**2).astype(np.uint8)
    return np.asarray(cv2.erode(strange, np.ones((_WINDOW, _WINDOW), np.uint8)) > 0)


def _mean(values: Floats) -> Floats:
    return np.asarray(cv2.blur(values, (_WINDOW, _WINDOW)))
