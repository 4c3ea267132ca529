"""Shapes before several cameras of varying magnification, with the size of the object held constant."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.many_cameras.many_views import ManyViewSettings, ManyViewShapes, factorise_views

_OF_CAMERAS = ("camera_from_first", "camera_sd", "scale", "translation", "noise_sd", "residuals")
"""Fields of `ManyViewShapes` whose first axis is the cameras."""
_ROUNDS = 10
"""Number of rounds of alignment and scaling. Chosen by hand; results were not measured against other values."""
_FEWEST_SHARED = 6
"""In frames with fewer points seen by two cameras, those seen by one camera are used as well. Chosen by hand; results
were not measured against other values."""
_LEAST_RANGE = 0.01
"""Magnifications with a smaller range of logarithms are set to 1. Chosen by hand; results were not measured against
other values."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldSizeShapes:
    """Shapes of constant size, and their magnification by the cameras."""

    shapes: ManyViewShapes
    """Shapes from the tracks divided by the magnification."""
    magnification: Floats
    """(F,) magnification of a frame, 1 on average; the same in all cameras."""

    def __post_init__(self) -> None:
        freeze_fields(self, "magnification")


def factorise_at_held_size(tracks: Floats, settings: ManyViewSettings | None = None) -> HeldSizeShapes:
    """Estimate shapes from several cameras whose magnification changes with the object's distance.

    Uncalibrated cameras do not distinguish an object that grows from one that approaches. A limb bends but keeps its
    overall size, so a change of that size is attributed to the distance, in each frame for all cameras together.
    [Alexander2003] section 2.4 leaves it in the coefficients.

    Args:
        tracks: (C, F, 2, P) as for `factorise_views`; all NaN for a camera that shares no point.
        settings: Tuned constants of `factorise_views`; the defaults if None.

    Returns:
        The shapes; where the magnification is nearly constant, those of the unchanged tracks. Values of a camera that
        shares no point are NaN.

    Raises:
        MareyError: As `factorise_views`.
    """
    tracks = np.asarray(tracks, float)
    settings = settings or ManyViewSettings()
    used: Mask = np.asarray(np.isfinite(tracks).any(axis=(1, 2, 3)))
    found = factorise_views(tracks[used], settings)
    magnification = magnifications(found.shape, _known(tracks))
    if np.ptp(np.log(magnification)) < _LEAST_RANGE:
        magnification = np.ones(tracks.shape[1])
    else:
        found = factorise_views(tracks[used] / magnification[:, None, None], settings)
    return HeldSizeShapes(shapes=_of_all_cameras(found, used), magnification=magnification)


def _of_all_cameras(found: ManyViewShapes, used: Mask) -> ManyViewShapes:
    """Insert the results of some cameras among all of them; NaN for the others."""
    if used.all():
        return found

    def wide(values: Floats) -> Floats:
        full = np.full((len(used), *values.shape[1:]), np.nan)
        full[used] = values
        return full

    parts: dict[str, Any] = {name: wide(getattr(found, name)) for name in _OF_CAMERAS}
    return replace(found, **parts)


def _known(tracks: Floats) -> Mask:
    """Find the points (F, P) known in space: seen by two cameras or, in frames with few such points, by one."""
    cameras = np.isfinite(tracks).all(axis=2).sum(axis=0)
    twice = cameras >= 2
    return np.asarray(np.where((twice.sum(axis=1) >= _FEWEST_SHARED)[:, None], twice, cameras >= 1))


def magnifications(shape: Floats, known: Mask) -> Floats:
    """Estimate the sizes of shapes relative to their mean by scaled alignment ([Gower1975]).

    Args:
        shape: (F, 3, P).
        known: (F, P) mask of the points used.

    Returns:
        (F,) sizes, 1 on average; interpolated in frames with fewer than three used points.
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
    """Centre points (F, P, 3) on the mean of the known ones; 0 for the others."""
    kept = np.where(known[..., None], points, 0)
    middle = kept.sum(axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]
    return np.where(known[..., None], points - middle[:, None], 0)
