"""Borders between parts of different colours, found where they are and nowhere else."""

import numpy as np
import pytest

from marey.images.features.part_borders import change_point, part_borders
from marey.images.silhouettes.interior import InteriorEdges
from marey.images.silhouettes.part_colours import PartColourCounts

SIZE, LEFT, RIGHT = 120, 45, 75
SKIN, SHIRT = np.array([90.0, 120, 180]), np.array([160.0, 70, 60])
EVERYWHERE = np.ones((SIZE, SIZE), bool)


def arm(off=0):
    """A vertical forearm (part 1) before a shirt (part 0) that fills the image."""
    parts = np.zeros((SIZE, SIZE), np.int64)
    parts[:, LEFT + off : RIGHT + off] = 1
    return parts


def filmed(rng, *, front=SKIN, behind=SHIRT, spread=6.0):
    image = np.where((arm() == 1)[..., None], front, behind) + rng.normal(0, spread, (SIZE, SIZE, 3))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def rims(off=0):
    """The left rim of the drawn forearm; the normal points into it."""
    rows = np.arange(20, 100)
    pixels = np.stack([np.full(len(rows), LEFT + off), rows], -1).astype(float)
    return InteriorEdges(pixels=pixels, inward=np.tile([1.0, 0.0], (len(rows), 1)), limb=np.ones(len(rows), np.int64))


def learned(image, parts):
    counts = PartColourCounts(1, 2, 3)
    counts.add(0, image, parts, 1e-5)
    return counts.learned()[0]


@pytest.mark.parametrize("off", [-3, 0, 2])
def test_the_border_of_a_bare_forearm_before_a_shirt_is_found(rng, off):
    image = filmed(rng)
    offsets = part_borders(image, EVERYWHERE, rims(off), arm(off), learned(image, arm()))
    # The border lies between two pixels.
    np.testing.assert_allclose(offsets, -off - 0.5, atol=0.6)


def test_parts_of_one_colour_have_no_border(rng):
    image = filmed(rng, behind=SKIN)
    assert np.isnan(part_borders(image, EVERYWHERE, rims(), arm(), learned(image, arm()))).all()


def test_without_a_silhouette_or_beside_its_outline_nothing_is_found(rng):
    image = filmed(rng)
    colours = learned(image, arm())
    assert np.isnan(part_borders(image, ~EVERYWHERE, rims(), arm(), colours)).all()
    only_the_arm = arm() == 1
    assert np.isnan(part_borders(image, only_the_arm, rims(), arm(), colours)).all()
    assert len(part_borders(image, EVERYWHERE, InteriorEdges.none(), arm(), colours)) == 0


def test_the_change_point_has_the_largest_likelihood(rng):
    ratio = np.where(np.arange(30) < 17, -2.0, 2.0) + rng.normal(0, 1.0, 30)
    sums = [ratio[s:].sum() - ratio[:s].sum() for s in range(31)]
    assert change_point(ratio, 0, 29) == np.argmax(sums) - 0.5
    assert np.isnan(change_point(-ratio, 0, 29))
    assert np.isnan(change_point(ratio, 20, 29))
