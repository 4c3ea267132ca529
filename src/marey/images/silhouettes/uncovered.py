"""Background of a camera from the images in which the person is elsewhere, if there is no image of the empty room."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.compiled.kernels import kernel
from marey.images.silhouettes.background import Background, background_of

ALIKE = 6.0
"""Colours that differ by less in every channel are equal [grey levels]. Chosen by hand: three times the noise of the
rendered takes, since flicker and automatic exposure are compensated by one factor only."""
ENOUGH = 5
"""Number of images in which a pixel must be uncovered for its most frequent colour to be certain. Chosen by hand."""
EVERY = 7
"""Distance of the pixels from which the brightness of the images is compared, in rows and in columns [px]."""
UNLIKE = 15.0
"""Difference from the background in any channel above which a pixel shows something else [grey levels]. Three standard
deviations of a pixel about a learned background, of 5 grey levels."""
MOST_CHANGED, LEAST_REVEALED = 0.1, 0.8
"""What distinguishes an image without the person: the pixels that are different from the known background are fewer
than this share of the person's area, and of those that the person always covers more than this share are different. In
the images of `jacks` and `reach`, with true silhouettes, the shares are at most 0.07 and at least 0.94 in those of the
empty room, and at least 0.16 and at most 0.75 in those with the person."""


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
    factors = _same_brightness(pictures)
    mean, share, count = _most_frequent_uncovered(np.stack(pictures), factors, ~np.stack(covered), np.float32(ALIKE))
    confidence = share * np.minimum(count / np.float32(ENOUGH), 1.0)
    middle = pictures[len(pictures) // 2].astype(np.float32)
    return background_of(np.where(count[..., None] > 0, mean, middle), confidence=confidence)


def background_with_empty(
    pictures: Sequence[Image], covered: Sequence[Mask], inside: Mask, others: Sequence[Image]
) -> Background:
    """Estimate a background, see `background_where_uncovered`, also from those of some other images that show nobody.

    Args:
        pictures: N images (H, W, C) uint8 of one size that show the person.
        covered: N masks (H, W), true where the person may be.
        inside: (H, W) true where the person is in all of these images.
        others: Images of this size of frames in which the person was not found. It may be there nevertheless.

    Returns:
        The background.
    """
    background = background_where_uncovered(pictures, covered)
    area = float(np.median([np.count_nonzero(mask) for mask in covered]))
    empty = [picture for picture in others if shows_nobody(picture, background, inside, area)]
    if not empty:
        return background
    nothing = [np.zeros(inside.shape, bool)] * len(empty)
    return background_where_uncovered([*pictures, *empty], [*covered, *nothing])


def shows_nobody(picture: Image, background: Background, inside: Mask, area: float) -> bool:
    """Return whether the person who hides a part of the background in other images is not in this one.

    Args:
        picture: (H, W, C) uint8 image.
        background: The background, which has the colours of the person where the person always is, see
            `background_where_uncovered`.
        inside: (H, W) true where the person is in all other images.
        area: Area of the person in other images [px].

    Returns:
        True if the image is that of the known background, and different where the person is in all other images. False
        if there is no such place: then the image adds nothing to the background.
    """
    if not inside.any():
        return False
    shown = picture.astype(np.float32) + 1.0
    factor = np.median(shown[::EVERY, ::EVERY] / (background.mean[::EVERY, ::EVERY] + 1.0), axis=(0, 1))
    different = np.abs(shown / factor - background.mean - 1.0).max(axis=2) > UNLIKE
    changed = np.count_nonzero(different & (background.confidence > 0.5))
    return bool(changed < MOST_CHANGED * area and different[inside].mean() > LEAST_REVEALED)


def _same_brightness(pictures: Sequence[Image]) -> Floats:
    """Return the factors (N, C) float32 that bring the images to the brightness of the middle one."""
    reference = pictures[len(pictures) // 2][::EVERY, ::EVERY].astype(np.float32) + 1.0
    ratios = [reference / (picture[::EVERY, ::EVERY].astype(np.float32) + 1.0) for picture in pictures]
    return np.asarray([np.median(ratio, axis=(0, 1)) for ratio in ratios], np.float32)


@kernel
def _most_frequent_uncovered(pictures, factors, uncovered, tolerance):
    """Return the mean of the largest group of similar colours, its share, and the number of uncovered images."""
    count, height, width, channels = pictures.shape
    mean = np.zeros((height, width, channels), np.float32)
    share, number = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    colours = np.empty((count, channels), np.float32)
    for y in range(height):
        for x in range(width):
            n = 0
            for i in range(count):
                if uncovered[i, y, x]:
                    for c in range(channels):
                        colours[n, c] = min(factors[i, c] * np.float32(pictures[i, y, x, c]), np.float32(255.0))
                    n += 1
            if n == 0:
                continue
            best, most = 0, 0
            for a in range(n):
                alike = 0
                for b in range(n):
                    alike += _alike(colours, a, b, tolerance)
                if alike > most:
                    best, most = a, alike
                if 2 * most > n:
                    break
            for b in range(n):
                if _alike(colours, best, b, tolerance):
                    for c in range(channels):
                        mean[y, x, c] += colours[b, c]
            for c in range(channels):
                mean[y, x, c] /= np.float32(most)
            share[y, x], number[y, x] = np.float32(most) / np.float32(n), n
    return mean, share, number


@kernel
def _alike(colours, i, j, tolerance):
    """Return whether two colours are similar."""
    alike = True
    for c in range(colours.shape[1]):
        alike &= abs(colours[i, c] - colours[j, c]) <= tolerance
    return alike
