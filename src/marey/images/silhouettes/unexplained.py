"""Texture that an image of the empty room does not explain, which indicates a textured object in front of it."""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask

_WINDOW = 13
"""Width and height of the windows that are compared [px]. Chosen by hand."""
_LEAST = 5.0
"""Least standard deviation of the residual that neither noise nor compression explains [grey levels]. Chosen by
hand."""


@dataclass(frozen=True, eq=False)
class RoomTexture:
    """The grey values of an empty room with their mean and variance about each pixel, the same for all images."""

    grey: Floats
    """(H, W) float32 mean of the channels [grey levels]."""
    mean: Floats
    """(H, W) mean of a window [grey levels]."""
    variance: Floats
    """(H, W) variance of a window [grey2]."""

    @staticmethod
    def of(empty: Floats) -> "RoomTexture":
        """Prepare the image (H, W, 1 or 3) of an empty room."""
        grey = _grey(empty)
        mean = _mean(grey)
        return RoomTexture(grey, mean, _mean(grey * grey) - mean**2)


def unexplained_texture(image: Image, room: RoomTexture) -> Mask:
    """Return where an image's texture is not that of the empty room, independent of brightness.

    About each pixel the grey values are regressed on those of the empty room. A shadow, which only scales them, leaves
    no residual; a speckled surface leaves a large one, even if its mean colour is that of the room.

    Args:
        image: (H, W, 3).
        room: The empty room in the same camera.

    Returns:
        (H, W) true in such regions, which are eroded by half a window, because windows at their borders contain the
        room too.
    """
    now = _grey(image)
    mean = _mean(now)
    both = _mean(now * room.grey) - mean * room.mean
    left = _mean(now * now) - mean**2 - both**2 / np.maximum(room.variance, 1e-3)
    strange = (left > _LEAST**2).astype(np.uint8)
    return np.asarray(cv2.erode(strange, np.ones((_WINDOW, _WINDOW), np.uint8)) > 0)


def _grey(image: Image | Floats) -> Floats:
    channels = image.shape[-1]
    values = np.asarray(image, np.float32)
    return np.asarray(cv2.transform(values, np.full((1, channels), 1 / channels, np.float32)).reshape(image.shape[:2]))


def _mean(values: Floats) -> Floats:
    return np.asarray(cv2.blur(values, (_WINDOW, _WINDOW)))
