"""Background of a camera from the images in which the person is elsewhere, if there is no image of the empty room."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.images.silhouettes.background import Background, background_of
from marey.kernels import kernel

ALIKE = 6.0
"""Colours that differ by less in every channel are equal [grey levels]. Chosen by hand: three times the noise of the
rendered takes, since flicker and automatic exposure are compensated by one factor only."""
ENOUGH = 5
"""Number of images in which a pixel must be uncovered for its most frequent colour to be certain. Chosen by hand."""
EVERY = 7
"""Distance of the pixels from which the brightness of the images is compared, in rows and in columns [px]."""


def background_where_uncovered(pictures: Sequence[Image], covered: Sequence[Mask]) -> Background:
    """Estimate a background from images of the take, each without the region in which the person may be.

    The background is the most frequent colour of the images in which a pixel is uncovered. Its confidence is the share
    of these images that have this colour, so that it is low where other people pass, where a screen changes, and where
    leaves move; it is zero where the person always is.

    Args:
        pictures: N images (H, W, C) uint8 of one size, distributed over the take.
        covered: N masks (H, W), true where the person may be, enlarged by the uncertainty of the pose.

    Returns:
        The background.

    Raises:
        ValueError: There is no image, or the sizes differ.
    """
    if not pictures or len(pictures) != len(covered):
        raise ValueError("a background needs images, and a mask for each of them")
    level = _same_brightness(pictures)
    mean, share, count = _most_frequent_uncovered(level, ~np.stack(covered), np.float32(ALIKE))
    confidence = share * np.minimum(count / np.float32(ENOUGH), 1.0)
    middle = level[len(level) // 2]
    return background_of(np.where(count[..., None] > 0, mean, middle), confidence=confidence)


def _same_brightness(pictures: Sequence[Image]) -> Floats:
    """Return the images (N, H, W, C) float32, each with the factor per channel that the middle one needs least."""
    reference = pictures[len(pictures) // 2][::EVERY, ::EVERY].astype(np.float32) + 1.0
    level = []
    for picture in pictures:
        factor = np.median(reference / (picture[::EVERY, ::EVERY].astype(np.float32) + 1.0), axis=(0, 1))
        level.append(np.clip(picture * factor.astype(np.float32), 0.0, 255.0).astype(np.float32))
    return np.stack(level)


@kernel
def _most_frequent_uncovered(pictures, uncovered, tolerance):
    """Return the mean of the largest group of similar colours, its share, and the number of uncovered images."""
    count, height, width, channels = pictures.shape
    mean = np.zeros((height, width, channels), np.float32)
    share, number = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    index = np.empty(count, np.int64)
    for y in range(height):
        for x in range(width):
            n = 0
            for i in range(count):
                if uncovered[i, y, x]:
                    index[n] = i
                    n += 1
            if n == 0:
                continue
            best, most = 0, 0
            for a in range(n):
                alike = 0
                for b in range(n):
                    alike += _alike(pictures, index[a], index[b], y, x, tolerance)
                if alike > most:
                    best, most = index[a], alike
                if 2 * most > n:
                    break
            total = 0
            for b in range(n):
                if _alike(pictures, best, index[b], y, x, tolerance):
                    total += 1
                    for c in range(channels):
                        mean[y, x, c] += pictures[index[b], y, x, c]
            for c in range(channels):
                mean[y, x, c] /= np.float32(total)
            share[y, x], number[y, x] = np.float32(total) / np.float32(n), n
    return mean, share, number


@kernel
def _alike(pictures, i, j, y, x, tolerance):
    """Return whether a pixel has the same colour in two images."""
    alike = True
    for c in range(pictures.shape[3]):
        alike &= abs(pictures[i, y, x, c] - pictures[j, y, x, c]) <= tolerance
    return alike
