"""Covariance of tracked points: the noise of the matches, what the residuals show, and the bend of the surface."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.cameras.triangulate import TriangulatedPoints
from marey.surface.points.intersection import bend_displacements, variance_factor
from marey.surface.points.settings import INTERSECTION_DEFAULTS

_LEAST_NEIGHBOURS = 3
"""Number of neighbours, in a plane of maps, below which a point's bend is not estimated: a plane has three unknowns,
and the point itself counts."""


@dataclass(frozen=True, kw_only=True)
class TrackUncertaintySettings:
    """Settings of the covariance of tracked points."""

    neighbours: int = 24
    """Largest number of neighbours from whose affine maps the surface's curvature is estimated. Chosen by hand."""
    bend_sd_ratio: float = INTERSECTION_DEFAULTS.bend_sd_ratio
    """Standard deviation of the bend's effect, as a share of it; as for the points of one instant."""


TRACK_UNCERTAINTY_DEFAULTS = TrackUncertaintySettings()
"""Default settings of the covariance of tracked points."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PointsOfFrame:
    """Tracked points measured in one frame."""

    position: Floats
    """(n, 3) [m]."""
    covariance: Floats
    """(n, 3, 3) from the matches alone [m2]."""
    pixels: Floats
    """(n, C, 2) pixels in the views that show the points [px]."""
    sd: Floats
    """(n, C) standard deviations of these pixels by the matches [px]."""
    template: Integers
    """(n,) view from which the others were matched."""
    across: Floats
    """(n, C, 2, 2) linear parts of the maps from the template view to each view."""


def stated_covariance(
    points: PointsOfFrame, cameras: Sequence[Camera], *, floor_px: float, size: int,
    settings: TrackUncertaintySettings = TRACK_UNCERTAINTY_DEFAULTS,
) -> Floats:  # fmt: skip
    """Complete the covariance of the points of a frame.

    The covariance of the matches is multiplied by the factor that the residuals of the frame show, and the effect of
    the surface's curvature is added to it, as for the points of one instant (`marey.surface.points.intersection`).

    Args:
        points: The points.
        cameras: C cameras.
        floor_px: Standard deviation of a pixel beyond that of its matches [px].
        size: Width and height of the patches [px].
        settings: Settings.

    Returns:
        (n, 3, 3) [m2].
    """
    if not len(points.position):
        return points.covariance
    shown = np.isfinite(points.sd)
    usual = np.sqrt(np.nanmean(points.sd**2, axis=1))
    sigma = np.where(shown, np.hypot(usual, floor_px)[:, None], np.nan)
    solved = TriangulatedPoints(
        points=points.position, covariance=points.covariance, residual_px=np.zeros(len(shown)),
        views=np.count_nonzero(shown, axis=1),
    )  # fmt: skip
    factor = variance_factor(cameras, solved, points.pixels, sigma, np.ones(len(shown), bool))
    bend = bends_of_tracks(points, half=size // 2, neighbours=settings.neighbours)
    aside = bend_displacements(cameras, points.position, bend, np.where(shown, 1.0, np.nan))
    squares = (1 + settings.bend_sd_ratio**2) * aside[:, :, None] * aside[:, None, :]
    return np.asarray(factor * points.covariance + squares)


def bends_of_tracks(points: PointsOfFrame, *, half: int, neighbours: int) -> Floats:
    """Estimate the displacement of the matches between the views by the curvature of the surface.

    As `marey.surface.points.bend.bends`, from points in any arrangement: planes are fitted to the elements of the
    affine maps of a point and its neighbours in the template's image, up to the size of a patch away.

    Args:
        points: The points.
        half: Pixels from a patch's centre to its edge.
        neighbours: Largest number of neighbours.

    Returns:
        (n, C, 2) displacements [px]: zero in the template, NaN in views that do not show the point. Points with fewer
        than three neighbours have the median size of the others' displacements.
    """
    count, views = points.sd.shape
    drawn, alone = np.full((count, views, 2), np.nan), np.zeros((count, views), bool)
    shown = np.isfinite(points.sd)
    for origin in range(views):
        own = np.flatnonzero((points.template == origin) & shown[:, origin])
        if not len(own):
            continue
        drawn[own, origin] = 0.0
        place = points.pixels[own, origin]
        near = cKDTree(place).query(place, k=neighbours + 1, distance_upper_bound=2 * half + 1)[1]
        for view in range(views):
            rows = np.flatnonzero(shown[own, view])
            if view != origin and len(rows):
                bend, few = _bends_of_maps(place, points.across[own, view], near[rows], rows, shown[own, view], half)
                drawn[own[rows], view], alone[own[rows], view] = bend, few
    known = shown & ~alone & (points.template[:, None] != np.arange(views))
    drawn[alone] = np.median(np.abs(drawn[known]), axis=0) if known.any() else 0.0
    return drawn


def _bends_of_maps(
    place: Floats, maps: Floats, near: Integers, rows: Integers, shown: Mask, half: int
) -> tuple[Floats, Mask]:
    """Return the displacements (m, 2) of points, and which of them have too few neighbours.

    Args:
        place: (n, 2) all points of a template [px].
        maps: (n, 2, 2) their maps to a view.
        near: (m, k) the points' neighbours and themselves; n for none.
        rows: (m,) the points.
        shown: (n,) which points the view shows.
        half: Pixels from a patch's centre to its edge.
    """
    there = near < len(place)
    index = np.where(there, near, 0)
    used = there & shown[index]
    step = np.where(used[..., None], place[index] - place[rows, None], 0.0)
    design = np.concatenate([used[..., None].astype(float), step], axis=-1)
    turned = np.swapaxes(design, 1, 2)
    # This makes the slope zero in directions without neighbours.
    normal = turned @ design + np.diag([0.0, 1e-6 * half**2, 1e-6 * half**2])
    slopes = np.linalg.solve(normal, turned @ maps[index].reshape(*index.shape, 4))
    mean = half * (half + 1) / 3.0
    along = np.stack([slopes[:, 1, 0] + slopes[:, 2, 1], slopes[:, 1, 2] + slopes[:, 2, 3]], axis=-1)
    return 0.5 * mean * along, np.count_nonzero(used, axis=1) <= _LEAST_NEIGHBOURS
