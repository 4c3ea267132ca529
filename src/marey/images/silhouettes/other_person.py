"""The region of another person in an image, from a rough figure and the colours of both people."""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask, freeze_fields
from marey.images.silhouettes.densities import COLOUR_SHIFT, COMMON, colour_density
from marey.images.silhouettes.level_sets import evolve
from marey.images.silhouettes.part_colours import RING, RING_SCALE, UNIFORM_SHARE

FIGURE_SLOPE, FIGURE_LIMIT = 1.7, 1.5
"""Log-likelihood ratio per standard deviation of distance from the outline of a figure, which makes the logistic
function resemble the normal distribution's, and its limit. Chosen by hand: a figure is wrong by the width of a limb,
and the colours decide."""
BEYOND_SDS, BEYOND = 2.5, 6.0
"""Distance from a figure beyond which nothing belongs to the other person, in standard deviations, and the
log-likelihood ratio against it there. Chosen by hand."""
COLOUR_LIMIT = 4.0
"""Limit of the log-likelihood ratio of a pixel's colours. Chosen by hand."""
BORDER_LENGTH = 3.0
"""Weight of the length of the border of the other person. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class TwoColours:
    """Densities of the colours of the followed person and of other people in one camera."""

    followed: Floats
    """Density as in `colour_density`."""
    others: Floats
    """Density as in `colour_density`."""

    def __post_init__(self) -> None:
        freeze_fields(self, "followed", "others", dtype=np.float32)

    def ratio(self, image: Image) -> Floats:
        """Return the log-likelihood ratio (H, W) of other people and the followed person at each pixel of an image."""
        uniform = UNIFORM_SHARE * COMMON[image.shape[2]] * 256.0 ** -image.shape[2]
        table = np.log((1 - UNIFORM_SHARE) * self.others + uniform)
        table -= np.log((1 - UNIFORM_SHARE) * self.followed + uniform)
        np.clip(table, -COLOUR_LIMIT, COLOUR_LIMIT, out=table)
        if image.shape[2] == 1:
            return np.asarray(table[image[..., 0]])
        cells = image >> COLOUR_SHIFT
        return np.asarray(table[cells[..., 0], cells[..., 1], cells[..., 2]])


def other_region(image: Image, figure: Mask, sd_px: float, colours: TwoColours, followed: Mask) -> Mask:
    """Segment another person, given a figure, against the surroundings and the followed person.

    Unlike the silhouette of the followed person, it does not depend on a background model: where another person always
    is, none can be learned.

    Args:
        image: (H, W, C) uint8.
        figure: (H, W) rough region of the other person; not empty.
        sd_px: Standard deviation of the figure's outline [px].
        colours: Colours of both people.
        followed: (H, W) where the followed person may be.

    Returns:
        (H, W) true where the other person is.
    """
    inside, outside = (np.ascontiguousarray(side).view(np.uint8) for side in (figure, ~figure))
    away = cv2.distanceTransform(outside, cv2.DIST_L2, 3)
    prior = (cv2.distanceTransform(inside, cv2.DIST_L2, 3) - away) * np.float32(FIGURE_SLOPE / sd_px)
    prior = np.clip(prior, -FIGURE_LIMIT, FIGURE_LIMIT)
    prior[away > BEYOND_SDS * sd_px] = -BEYOND
    scale = RING_SCALE / float(np.sqrt(figure.size))
    ring = (away > BEYOND_SDS * sd_px) & (away * scale < RING[1]) & ~followed
    around = TwoColours(colour_density(image, ring), colours.others).ratio(image)
    votes = np.where(followed, np.minimum(colours.ratio(image), around), around) + prior
    votes = np.ascontiguousarray(votes, np.float32)
    start = cv2.GaussianBlur(votes, (0, 0), max(1.0, 1.5 / scale)) > 0
    return np.asarray(evolve(votes, start, length=BORDER_LENGTH))
