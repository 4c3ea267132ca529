"""Shapes before cameras that see things smaller when they are farther away: the object's size is held."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, frozen
from marey.nonrigid.alignment import mean_shape
from marey.nonrigid.many_views import ManyViewShapes, factorise_views

_ROUNDS = 10
_SLIGHT = 0.01
"""Magnifications that differ by less are none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldSizeShapes:
    """Shapes of one size, and how large the cameras show them."""

    shapes: ManyViewShapes
    """Those of the tracks divided by the magnification."""
    magnification: Floats
    """(F,) how large a frame's pictures are, 1 on average; the same in all cameras."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "magnification", frozen(self.magnification))


def factorise_at_held_size(tracks: Floats) -> HeldSizeShapes:
    """Find shapes from several cameras that show the object larger and smaller as it comes and goes.

    An object that grows and one that comes nearer look alike to cameras of which nothing is known. A limb bends,
    but as a whole it keeps its size: what changes of that is put down to the distance, in each frame for all cameras
    together. [Alexander2003] section 2.4 leaves it in the coefficients.

    Args:
        tracks: (C, F, 2, P) as for `factorise_views`.

    Returns:
        The shapes; where the magnification is as good as constant, those of the tracks as they are.

    Raises:
        MareyError: As `factorise_views`.
    """
    tracks = np.asarray(tracks, float)
    found = factorise_views(tracks)
    magnification = magnifications(found.shape)
    if np.ptp(np.log(magnification)) < _SLIGHT:
        return HeldSizeShapes(shapes=found, magnification=np.ones(tracks.shape[1]))
    return HeldSizeShapes(shapes=factorise_views(tracks / magnification[:, None, None]), magnification=magnification)


def magnifications(shape: Floats) -> Floats:
    """Give the sizes (F,) of shapes (F, 3, P) against their mean, 1 on average, by scaled alignment ([Gower1975])."""
    points = np.swapaxes(shape, 1, 2)
    points = points - points.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(points**2, axis=(1, 2)))
    everywhere = np.ones(points.shape[:2], bool)
    for _ in range(_ROUNDS):
        scaled = points / size[:, None, None]
        mean, rotation, _ = mean_shape(scaled, everywhere)
        aligned = np.einsum("fji,fpj->fpi", rotation, points)
        size = np.einsum("fpi,fpi->f", aligned, aligned) / np.einsum("fpi,pi->f", aligned, mean)
        size = size / np.exp(np.mean(np.log(size)))
    return np.asarray(size)
