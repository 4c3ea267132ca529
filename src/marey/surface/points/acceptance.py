"""Acceptance of matches."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.epipolar import epipolar_lines
from marey.images.matching.matching import Matches
from marey.surface.points.views import SurfaceView


@dataclass(frozen=True, kw_only=True)
class MatchLimits:
    """Thresholds for the acceptance of a match."""

    correlation: float
    """Least correlation."""
    sd_px: float
    """Largest standard deviation in the weakest direction [px]."""
    epipolar_px: float
    """Largest distance from the epipolar line [px]."""


def accepted(template: SurfaceView, search: SurfaceView, pixels: Floats, found: Matches, limits: MatchLimits) -> Mask:
    """Return which matches (n,) are accepted, each by itself.

    Args:
        template: The view from which the patches were taken.
        search: The view in which they were found.
        pixels: (n, 2) centres of the patches in the template [px].
        found: The matches.
        limits: The thresholds.

    Returns:
        (n,) true for matches that converged, have sufficient correlation and precision, and lie near their epipolar
        lines, in front of both cameras and within the mask.
    """
    fine = found.converged & (found.correlation >= limits.correlation)
    fine[fine] = weakest_sd(found.covariance[fine]) <= limits.sd_px
    fine[fine] = search.shows(found.pixels[fine])
    fine[fine] = np.abs(epipolar_distances(template, search, pixels[fine], found.pixels[fine])) <= limits.epipolar_px
    return fine


def weakest_sd(covariance: Floats) -> Floats:
    """Return the standard deviation (n,) in the weakest direction of covariances (n, 2, 2)."""
    across, both, down = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.sqrt(0.5 * (across + down + np.sqrt((across - down) ** 2 + 4 * both**2)))


def epipolar_distances(template: SurfaceView, search: SurfaceView, pixels: Floats, there: Floats) -> Floats:
    """Compute the signed distances (n,) of matches from their epipolar lines, positive right of growing depth [px].

    NaN where the rays intersect behind a camera.
    """
    points, along = epipolar_lines(template.camera, search.camera, pixels, there)
    away = there - points
    return away[:, 1] * along[:, 0] - away[:, 0] * along[:, 1]
