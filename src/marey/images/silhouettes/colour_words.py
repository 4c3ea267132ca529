"""Colour words and motion words: the few classes of pixels from which a person is found without any background."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, reduce
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, Image, Integers, Mask, freeze_fields, frozen
from marey.compiled.kernels import kernel

WORD_COUNT = 40
"""Number of colour words of a take. From the measured recipe for rooms without a plate; others were not compared."""
LIGHTNESS_WEIGHT, TEXTURE_WEIGHT = 0.6, 6.0
"""Weights of the lightness and of the logarithm of its local standard deviation beside the two opponent colours of
CIE L*a*b*. From the same recipe."""
TEXTURE_WINDOW = 9
"""Side of the window of the local standard deviation [px]. From the same recipe."""
SAMPLED_PIXELS = 20000
"""Number of pixels from which the words are learned. Chosen by hand."""
MOTION_OFFSETS = (-8, -6, -4, -2, 2, 4, 6, 8)
"""Other frames with which an image is compared, relative to its own. From the same recipe, at 30 Hz."""
MOTION_QUANTILE = 0.6
"""Quantile of the differences to these frames that is the motion of a pixel. From the same recipe."""
MOTION_CUTS = (3.0, 6.0, 10.0, 16.0, 28.0)
"""Limits between the motion words [grey levels]. From the same recipe."""
MOTION_INSIDE = frozen([0.30, 0.14, 0.14, 0.16, 0.14, 0.12])
"""(6,) probability of each motion word where the person is. From the same recipe."""
MOTION_OUTSIDE = frozen([0.80, 0.10, 0.04, 0.03, 0.02, 0.01])
"""(6,) probability of each motion word elsewhere, where nothing else is known. From the same recipe."""
MOTION_SHARE = 0.5
"""Weight of the log-likelihood ratio of motion, because motion and colour are not independent. From the same recipe."""
MOTION_PRIOR = 5.0
"""Number of images for which `MOTION_OUTSIDE` counts beside those in which a pixel is uncovered. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class ColourWords:
    """The colour words of a take: centres of clusters of colour and texture, common to all cameras."""

    centres: Floats
    """(K, 4) features as in `word_features`."""

    def __post_init__(self) -> None:
        freeze_fields(self, "centres", dtype=np.float32)

    def __len__(self) -> int:
        """Return the number of words."""
        return len(self.centres)

    def of(self, picture: Image) -> Integers:
        """Return the word of each pixel (H, W) uint8 of an image (H, W, C) uint8."""
        return np.asarray(_nearest(word_features(picture), self.centres))


def learned_words(pictures: Sequence[Image], *, count: int = WORD_COUNT) -> ColourWords:
    """Learn the colour words of a take; the result is the same in every run.

    Args:
        pictures: Images (H, W, C) uint8 of some frames of all cameras, of one number of channels.
        count: Number of words.

    Returns:
        The words.
    """
    features = np.concatenate([word_features(picture)[::2, ::2].reshape(-1, 4) for picture in pictures])
    chosen = np.random.default_rng(0).permutation(len(features))[:SAMPLED_PIXELS]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 25, 0.1)
    cv2.setRNGSeed(0)
    labels = np.empty((0, 1), np.int32)
    _, _, centres = cv2.kmeans(features[chosen], count, labels, criteria, 1, cv2.KMEANS_PP_CENTERS)
    return ColourWords(np.asarray(centres, np.float32))


def word_features(picture: Image) -> Floats:
    """Return lightness, two opponent colours and texture (H, W, 4) float32 of an image (H, W, C) uint8."""
    colour = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.shape[2] == 1 else picture
    lab = cv2.cvtColor(colour.astype(np.float32) / np.float32(255), cv2.COLOR_BGR2LAB)
    lightness = lab[..., 0]
    window = (TEXTURE_WINDOW, TEXTURE_WINDOW)
    mean = cv2.blur(lightness, window)
    spread = np.sqrt(np.maximum(cv2.blur(lightness * lightness, window) - mean * mean, 0))
    return np.dstack([LIGHTNESS_WEIGHT * lightness, lab[..., 1], lab[..., 2], TEXTURE_WEIGHT * np.log1p(spread)])


def motion_words(picture: Image, others: Sequence[Image]) -> Integers:
    """Return the motion word of each pixel of an image, from its differences to images some frames away.

    Args:
        picture: (H, W, C) uint8.
        others: Images of the same size, see `MOTION_OFFSETS`; none at all count as no motion.

    Returns:
        (H, W) uint8, from 0 for no motion to the number of `MOTION_CUTS`.
    """
    if not others:
        return np.zeros(picture.shape[:2], np.uint8)
    differences = [largest_channel(cv2.absdiff(picture, other).reshape(picture.shape)) for other in others]
    rank = round(MOTION_QUANTILE * (len(others) - 1))
    return np.asarray(_motion_classes()[_ranked(np.stack(differences), rank)])


@cache
def _motion_classes() -> Integers:
    """Return the motion word of each difference of grey levels (256,)."""
    return frozen(np.digitize(np.arange(256), MOTION_CUTS), np.uint8)


def largest_channel(image: NDArray[Any]) -> NDArray[Any]:
    """Return the largest of the channels of an image (H, W, C) at each pixel (H, W).

    It is the maximum along the last axis, which NumPy computes ten times slower for so few channels.
    """
    return np.asarray(reduce(np.maximum, (image[..., c] for c in range(image.shape[2]))))


def motion_outside(motion: Sequence[Integers], covered: Sequence[Mask]) -> Floats:
    """Learn how often each pixel has which motion word where the person is elsewhere.

    Screens, leaves and other people change all the time, and say nothing about the followed person.

    Args:
        motion: N images (H, W) uint8 of motion words.
        covered: N masks (H, W), true where the person may be.

    Returns:
        (6, H, W) probabilities.
    """
    words = np.arange(len(MOTION_OUTSIDE), dtype=np.uint8)[:, None, None]
    counts = np.zeros((len(MOTION_OUTSIDE), *motion[0].shape), np.float32)
    for image, person in zip(motion, covered, strict=True):
        counts += (image == words) & ~person
    known = counts + np.float32(MOTION_PRIOR) * MOTION_OUTSIDE.astype(np.float32)[:, None, None]
    return np.asarray(known / known.sum(axis=0))


def motion_ratio(motion: Integers, outside: Floats | None = None) -> Floats:
    """Return the log-likelihood ratio (H, W) of person and surroundings of the motion words of an image (H, W).

    Args:
        motion: (H, W) uint8.
        outside: (6, H, W) see `motion_outside`; by default the same for all pixels.
    """
    inside = np.log(MOTION_INSIDE)
    if outside is None:
        return np.asarray((MOTION_SHARE * (inside - np.log(MOTION_OUTSIDE))).astype(np.float32)[motion])
    elsewhere = np.take_along_axis(outside, motion[None].astype(np.intp), axis=0)[0]
    return np.asarray(MOTION_SHARE * (inside[motion] - np.log(elsewhere)), np.float32)


@kernel
def _ranked(images, rank):
    """Return the value of a rank, from 0, of each pixel (H, W) in images (N, H, W) uint8."""
    count, height, width = images.shape
    found, own = np.empty((height, width), np.uint8), np.empty(count, np.uint8)
    for y in range(height):
        for x in range(width):
            for n in range(count):
                value, place = images[n, y, x], n
                while place > 0 and own[place - 1] > value:
                    own[place] = own[place - 1]
                    place -= 1
                own[place] = value
            found[y, x] = own[rank]
    return found


@kernel
def _nearest(features, centres):
    height, width, channels = features.shape
    words = np.empty((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            best, nearest = np.float32(np.inf), 0
            for k in range(len(centres)):
                total = np.float32(0)
                for c in range(channels):
                    difference = features[y, x, c] - centres[k, c]
                    total += difference * difference
                if total < best:
                    best, nearest = total, k
            words[y, x] = nearest
    return words
