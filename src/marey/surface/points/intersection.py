"""Forward intersection of the rays of matched patches, and rejection of points whose rays do not intersect."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.cameras.triangulate import TriangulatedPoints, add_view, solve_normal, triangulate
from marey.surface.points.acceptance import epipolar_distances
from marey.surface.points.checks import confirmed_backward, in_large_pieces
from marey.surface.points.dense import Tuples
from marey.surface.points.measured import MeasuredPoints
from marey.surface.points.settings import SurfaceSettings
from marey.surface.points.views import SurfaceView

_MEDIAN_OF_CHI2 = {1: 0.4549, 3: 2.3660, 5: 4.3515, 7: 6.3458}
"""Median of the chi-squared distribution, by degrees of freedom."""


def intersect(views: Sequence[SurfaceView], tuples: Tuples, settings: SurfaceSettings, *, frame: int) -> MeasuredPoints:
    """Intersect the rays of tuples, and keep the points confirmed by three rays, or by two and the backward match.

    Args:
        views: Views of all C cameras, whose calibration may have improved since the tuples were matched.
        tuples: Corresponding matches.
        settings: Limits, and the errors of matches.
        frame: Frame number of the points.

    Returns:
        The points, with a covariance that includes their residuals and the effect of the surface's curvature.
    """
    cameras = [view.camera for view in views]
    pixels, kept = np.array(tuples.pixels), np.ones(len(tuples), bool)
    own_settings = settings.intersection
    sigma = np.hypot(tuples.sd, own_settings.floor_px)
    pixels[_off_their_lines(views, tuples, settings)] = np.nan
    # With many cameras all around, a template is compared with only a few.
    used = np.flatnonzero(np.isfinite(pixels[..., 0]).any(axis=0))
    own, there, spread = [cameras[i] for i in used], pixels[:, used], sigma[:, used]
    solved = triangulate(own, there.swapaxes(0, 1), sigma_px=spread.T) if len(used) else _nothing()
    kept &= solved.views >= 2
    most = kept & (solved.views >= min(3, solved.views.max(initial=0)))
    kept &= solved.residual_px <= _limit(solved.residual_px[most], settings)
    if most.any() and np.median(solved.residual_px[most]) > own_settings.unmet_ratio * settings.residual_px:
        kept[:] = False
    two = np.flatnonzero(kept & (solved.views == 2))
    kept[two] = _confirmed_by_two(views, tuples, pixels, two, settings)
    whole = np.zeros(len(tuples.grid), bool)
    whole[tuples.nodes[kept]] = True
    kept &= in_large_pieces(whole, tuples.grid, settings.checks)[tuples.nodes]
    factor = variance_factor(own, solved, there, spread, kept)
    bend = np.where(np.isfinite(there), tuples.bend[:, used], np.nan)[kept]
    aside = bend_displacements(own, solved.points[kept], bend, spread[kept])
    squares = (1 + own_settings.bend_sd_ratio**2) * aside[:, :, None] * aside[:, None, :]
    return MeasuredPoints(
        frame=np.full(kept.sum(), frame), points=solved.points[kept],
        covariance=factor * solved.covariance[kept] + squares,
        camera_names=tuple(camera.name for camera in cameras), pixels=pixels[kept],
        correlation=np.where(np.isfinite(pixels[kept, :, 0]), tuples.correlation[kept], np.nan),
        residual_px=solved.residual_px[kept], colour=tuples.colour[kept],
    )  # fmt: skip


def bend_displacements(cameras: Sequence[Camera], points: Floats, bend: Floats, sigma: Floats) -> Floats:
    """Compute the displacement (n, 3) of points if all their pixels move by the effect of the surface's curvature [m].

    All views see the same surface, so that these displacements act together and the residuals do not show them.

    Args:
        cameras: C cameras.
        points: (n, 3) intersected points [m].
        bend: (n, C, 2) displacements of the matches [px]; NaN in unused views.
        sigma: (n, C) standard deviations by which the views were weighted [px].

    Returns:
        (n, 3) displacements [m].
    """
    normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for i, camera in enumerate(cameras):
        used = np.isfinite(bend[:, i, 0])
        weight = np.where(used, 1 / np.where(used, sigma[:, i], 1.0) ** 2, 0.0)
        moved = np.ascontiguousarray(bend[:, i])
        add_view(moved, camera.project_with_derivative(points)[1], weight, normal, right, np.empty(len(points)))
    aside = np.empty_like(right)
    solve_normal(normal, right, 0.0, aside)
    return aside


def _nothing() -> TriangulatedPoints:
    """Return the intersection of no rays."""
    none = np.zeros(0)
    return TriangulatedPoints(
        points=np.zeros((0, 3)), covariance=np.zeros((0, 3, 3)), residual_px=none, views=np.zeros(0, np.int64)
    )  # fmt: skip


def _limit(residual: Floats, settings: SurfaceSettings) -> float:
    """Return the residual above which a point is a gross error [px]."""
    own, most = settings.intersection, settings.residual_px
    return min(most, max(own.least_limit_px, own.median_ratio * float(np.median(residual)))) if len(residual) else most


def _off_their_lines(views: Sequence[SurfaceView], tuples: Tuples, settings: SurfaceSettings) -> Mask:
    """Return which matches (n, C) lie too far from their epipolar lines, relative to the median of their image."""
    off = np.zeros(tuples.correlation.shape, bool)
    for other in range(len(views)):
        if other != tuples.template:
            here, there = tuples.pixels[:, tuples.template], tuples.pixels[:, other]
            beside = np.abs(epipolar_distances(views[tuples.template], views[other], here, there))
            known = np.isfinite(there[:, 0])
            off[:, other] = known & ~(beside <= 2 * _limit(beside[known & np.isfinite(beside)], settings))
    return off


def _confirmed_by_two(
    views: Sequence[SurfaceView], tuples: Tuples, pixels: Floats, some: Integers, settings: SurfaceSettings
) -> Mask:
    """Return which of some tuples (m,) of two views the backward match confirms."""
    good = np.zeros(len(some), bool)
    for other in range(len(views)):
        if other == tuples.template:
            continue
        which = np.flatnonzero(np.isfinite(pixels[some, other, 0]))
        rows = some[which]
        good[which] = confirmed_backward(
            views[tuples.template], views[other], tuples.pixels[rows, tuples.template], tuples.pixels[rows, other],
            tuples.maps[rows, other], tuples.size[rows, other], settings.checks,
        )  # fmt: skip
    return good


def variance_factor(
    cameras: Sequence[Camera], solved: TriangulatedPoints, pixels: Floats, sigma: Floats, some: Mask
) -> float:
    """Compute the ratio of the squared residuals to those expected from the matches' covariances; at least 1.

    Args:
        cameras: C cameras.
        solved: The n intersected points.
        pixels: (n, C, 2) pixels of the points [px].
        sigma: (n, C) standard deviations of the pixels [px].
        some: (n,) points that are used.

    Returns:
        The ratio of the medians, over the points with the largest number of views.
    """
    if not some.any():
        return 1.0
    most = int(solved.views[some].max())
    some = some & (solved.views == most)
    there = np.stack([camera.project(solved.points[some]) for camera in cameras], axis=1)
    squares = np.nansum(np.sum((there - pixels[some]) ** 2, axis=-1) / sigma[some] ** 2, axis=1)
    freedom = 2 * most - 3
    expected = _MEDIAN_OF_CHI2.get(freedom, freedom * (1 - 2 / (9 * freedom)) ** 3)
    return max(1.0, float(np.median(squares)) / expected)
