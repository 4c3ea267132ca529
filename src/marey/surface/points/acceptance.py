"""Which matches are believed."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.epipolar import epipolar_lines
from marey.images.matching.matching import Matches
from marey.surface.points.views import SurfaceView


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Thresholds on a match."""

    correlation: float
    """At least."""
    sd_px: float
    """In its weakest direction, at most [px]."""
    epipolar_px: float
    """From the line, at most [px]."""


def good(template: SurfaceView, search: SurfaceView, pixels: Floats, found: Matches, limits: Limits) -> Mask:
    """Tell which matches (n,) are good in themselves.

    Args:
        template: The view of which patches were taken.
        search: The view in which they were found.
        pixels: (n, 2) the patches' centres in the template [px].
        found: Their matches.
        limits: What is asked of them.

    Returns:
        (n,) those that converged, correlate, are certain, lie near their epipolar lines before both cameras, and where
        the surface may be seen.
    """
    fine = found.converged & (found.correlation >= limits.correlation)
    fine[fine] = weakest_sd(found.covariance[fine]) <= limits.sd_px
    fine[fine] = search.shows(found.pixels[fine])
    fine[fine] = np.abs(beside_lines(template, search, pixels[fine], found.pixels[fine])) <= limits.epipolar_px
    return fine


def weakest_sd(covariance: Floats) -> Floats:
    """Give the standard deviation (n,) in the weakest direction of covariances (n, 2, 2)."""
    across, both, down = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.sqrt(0.5 * (across + down + np.sqrt((across - down) ** 2 + 4 * both**2)))


def beside_lines(template: SurfaceView, search: SurfaceView, pixels: Floats, there: Floats) -> Floats:
    """Measure how far matches lie beside their epipolar lines (n,), to the right of growing depth [px].

    NaN where the rays meet behind a camera.
    """
    points, along = epipolar_lines(template.camera, search.camera, pixels, there)
    away = there - points
    return away[:, 1] * along[:, 0] - away[:, 0] * along[:, 1]
