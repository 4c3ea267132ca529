"""Keypoints of pictures, matched by their neighbourhoods alone: what two pictures share, whatever their calibration."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask

_LARGEST_SIDE_PX = 1024
"""Larger images are reduced to this size before keypoints are detected [px]. Chosen by hand, for the time."""
_MOST = 2000
"""Largest number of keypoints of an image. Chosen by hand."""
_SECOND_RATIO = 0.75
"""A match is accepted if its distance in the space of descriptors is below this ratio of the second best: [Lowe2004]
recommends 0.8, which rejects 90 % of the wrong matches."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Keypoints:
    """Keypoints of an image, with the descriptors of their neighbourhoods."""

    pixels: Floats
    """(n, 2) positions [px]."""
    descriptors: Floats
    """(n, 128) descriptors, which do not depend on size and direction; a mirror image has others."""

    @cached_property
    def usable(self) -> bool:
        """Whether there are enough for a match: its best candidate and the second one."""
        return len(self.pixels) > 1


def keypoints(image: Image, mask: Mask | None = None) -> Keypoints:
    """Detect keypoints that do not depend on the size and direction of what an image shows.

    Args:
        image: (H, W, 3) blue, green, red.
        mask: (H, W) true where keypoints may lie; everywhere if None.

    Returns:
        The strongest keypoints.
    """
    factor = min(1.0, _LARGEST_SIDE_PX / max(image.shape))
    grey = cv2.cvtColor(np.asarray(image), cv2.COLOR_BGR2GRAY)
    within = None if mask is None else np.asarray(mask, np.uint8)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        if within is not None:
            within = np.asarray(cv2.resize(within, grey.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    found, descriptors = cv2.SIFT.create(_MOST, enable_precise_upscale=True).detectAndCompute(grey, within)
    pixels = (np.array([each.pt for each in found]).reshape(-1, 2) + 0.5) / factor - 0.5
    return Keypoints(
        pixels=pixels, descriptors=np.zeros((0, 128)) if descriptors is None else np.asarray(descriptors, float)
    )


def matched_keypoints(first: Keypoints, second: Keypoints) -> tuple[Floats, Floats]:
    """Match the keypoints of two images by their descriptors.

    Args:
        first: Keypoints of an image.
        second: Keypoints of another one.

    Returns:
        Pixels (n, 2) in both images [px].
    """
    if not (first.usable and second.usable):
        return np.zeros((0, 2)), np.zeros((0, 2))
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(
        first.descriptors.astype(np.float32), second.descriptors.astype(np.float32), k=2
    )  # fmt: skip
    clear = [best for best, other in nearest if best.distance < _SECOND_RATIO * other.distance]
    return first.pixels[[each.queryIdx for each in clear]], second.pixels[[each.trainIdx for each in clear]]
