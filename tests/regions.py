"""Images of words in which each part of a person has a word of its own, before a random background."""

from collections.abc import Sequence

import numpy as np

from marey.body.articulation.pose import PosedBody
from marey.cameras.camera import Camera
from marey.fit.regions.region_search import PARTS, RegionImages
from marey.observations.correspondence import view_of

WORDS = 24
"""Number of words; the first `PARTS` are those of the parts, and appear in the background too."""


def painted(posed: PosedBody, cameras: Sequence[Camera], rng: np.random.Generator | None = None) -> RegionImages:
    """Paint a posed body; without a generator, the background has one word that no part has."""
    shape = len(cameras), max(c.height for c in cameras), max(c.width for c in cameras)
    words = np.full(shape, PARTS, np.uint8) if rng is None else rng.integers(0, WORDS, shape).astype(np.uint8)
    for c, camera in enumerate(cameras):
        view = view_of(posed, camera)
        (x, y), (height, width) = view.corner, view.face.shape
        inside = view.face >= 0
        words[c, y : y + height, x : x + width][inside] = posed.body.face_colour_part[view.face[inside]]
    return RegionImages(words, np.zeros(shape))
