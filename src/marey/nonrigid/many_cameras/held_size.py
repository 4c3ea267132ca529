"""Shapes before cameras that see things smaller when they are farther away: the object's size is held."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.many_cameras.many_views import ManyViewShapes, factorise_views

_OF_CAMERAS = ("camera_from_first", "camera_sd", "scale", "translation", "noise_sd", "residuals")
_ROUNDS = 10
_FEWEST = 6
"""Points that two cameras see, below which those count that one sees."""
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
        freeze_fields(self, "magnification")


def factorise_at_held_size(tracks: Floats) -> HeldSizeShapes:
    """Find shapes from several cameras that show the object larger and smaller as it comes and goes.

    An object that grows and one that comes nearer look alike to cameras of which nothing is known. A limb bends,
    but as a whole it keeps its size: what changes of that is put down to the distance, in each frame for all cameras
    together. [Alexander2003] section 2.4 leaves it in the coefficients.

    Args:
        tracks: (C, F, 2, P) as for `factorise_views`; of a camera that shares no point all NaN.

    Returns:
        The shapes; where the magnification is as good as constant, those of the tracks as they are. What belongs to a
        camera that shares no point is NaN.

    Raises:
        MareyError: As `factorise_views`.
    """
    tracks = np.asarray(tracks, float)
    tied: Mask = np.asarray(np.isfinite(tracks).any(axis=(1, 2, 3)))
    found = factorise_views(tracks[tied])
    magnification = magnifications(found.shape, _known(tracks))
    if np.ptp(np.log(magnification)) < _SLIGHT:
        magnification = np.ones(tracks.shape[1])
    else:
        found = factorise_views(tracks[tied] / magnification[:, None, None])
    return HeldSizeShapes(shapes=_of_all_cameras(found, tied), magnification=magnification)


def _of_all_cameras(found: ManyViewShapes, tied: Mask) -> ManyViewShapes:
    """Give an answer of some cameras among all of them; NaN for the others."""
    if tied.all():
        return found

    def wide(values: Floats) -> Floats:
        full = np.full((len(tied), *values.shape[1:]), np.nan)
        full[tied] = values
        return full

    parts: dict[str, Any] = {name: wide(getattr(found, name)) for name in _OF_CAMERAS}
    return replace(found, **parts)


def _known(tracks: Floats) -> Mask:
    """Tell which places (F, P) are known in space: by two cameras; where those are few in a frame, by one."""
    cameras = np.isfinite(tracks).all(axis=2).sum(axis=0)
    twice = cameras >= 2
    return np.where((twice.sum(axis=1) >= _FEWEST)[:, None], twice, cameras >= 1)


def magnifications(shape: Floats, known: Mask) -> Floats:
    """Give the sizes of shapes against their mean, by scaled alignment ([Gower1975]).

    Args:
        shape: (F, 3, P).
        known: (F, P) which points count.

    Returns:
        (F,) 1 on average; between those of the nearest frames where a frame has fewer than three points that count.
    """
    points = np.swapaxes(shape, 1, 2)
    enough = known.sum(axis=1) >= 3
    size = np.ones(len(shape))
    for _ in range(_ROUNDS):
        mean, rotation, _ = mean_shape(points / size[:, None, None], known)
        target = np.nan_to_num(mean @ np.swapaxes(rotation, 1, 2))
        own, fit = _centred(points, known), _centred(target, known)
        ratio = np.sum(own * own, axis=(1, 2)) / np.maximum(np.sum(own * fit, axis=(1, 2)), 1e-300)
        ratio = np.interp(np.arange(len(shape)), np.flatnonzero(enough), ratio[enough])
        size = ratio / np.exp(np.mean(np.log(ratio)))
    return np.asarray(size)


def _centred(points: Floats, known: Mask) -> Floats:
    """Give points (F, P, 3) about the middle of those that are known; 0 for the others."""
    kept = np.where(known[..., None], points, 0)
    middle = kept.sum(axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]
    return np.where(known[..., None], points - middle[:, None], 0)
