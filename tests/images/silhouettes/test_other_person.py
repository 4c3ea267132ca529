"""Another person in an image: found by colours about a rough figure, and kept apart from the followed one."""

import numpy as np
import pytest

from marey.images.silhouettes.densities import colour_density
from marey.images.silhouettes.other_person import TwoColours, other_region

SHAPE = (240, 320)
OTHER, FOLLOWED = (40, 90, 200), (190, 120, 40)


def box(top, bottom, left, right):
    mask = np.zeros(SHAPE, bool)
    mask[top:bottom, left:right] = True
    return mask


@pytest.fixture
def scene():
    """A grey room; the other person stands in front of a part of the followed one."""
    rng = np.random.default_rng(3)
    other, followed = box(40, 220, 150, 200), box(80, 200, 180, 230)
    image = np.full((*SHAPE, 3), 110.0)
    image[followed], image[other] = FOLLOWED, OTHER
    image = np.clip(image + rng.normal(size=image.shape) * 4, 0, 255).astype(np.uint8)
    colours = TwoColours(colour_density(image, followed & ~other), colour_density(image, other))
    return image, other, followed, colours


def overlap(a, b):
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def test_the_outline_is_found_although_the_figure_is_too_wide_and_shifted(scene):
    image, other, followed, colours = scene
    found = other_region(image, box(32, 228, 140, 216), 8.0, colours, followed)
    assert overlap(found, other) > 0.97
    assert not (found & followed & ~other).any()


def test_nothing_far_from_the_figure_is_another_person(scene):
    image, other, followed, colours = scene
    image = image.copy()
    image[100:140, 20:60] = OTHER
    found = other_region(image, other, 8.0, colours, followed)
    assert not found[:, :80].any()


@pytest.mark.parametrize("channels", [1, 3])
def test_the_ratio_separates_the_colours(channels):
    image = np.zeros((2, 50, channels), np.uint8)
    image[0], image[1] = 60, 180
    first = np.zeros((2, 50), bool)
    first[0] = True
    colours = TwoColours(colour_density(image, first), colour_density(image, ~first))
    ratio = colours.ratio(image)
    assert (ratio[0] < -2).all()
    assert (ratio[1] > 2).all()
