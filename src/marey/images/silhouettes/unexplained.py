"""Texture that the picture of the empty room does not explain: where something with a texture stands before it."""

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask

_WINDOW = 13
"""Width and height of what is compared [px]."""
_LEAST = 5.0
"""Standard deviation that is no noise or compression [grey levels]."""


def unexplained_texture(image: Image, empty: Floats) -> Mask:
    """Tell where a picture's texture is not that of the empty room, however bright or dark.

    About each pixel the grey values are regressed on those of the empty room; a shadow, which only scales them, leaves
    nothing. What is left of a body's speckles is large, where their mean colour may well be the room's.

    Args:
        image: (H, W, 3).
        empty: (H, W, 1 or 3) the empty room, of the same camera.

    Returns:
        (H, W); half a window is taken off along the borders of such places, where windows hold the room, too.
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
