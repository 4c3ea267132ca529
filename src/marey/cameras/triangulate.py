"""Triangulation of points from their pixels in two or more views, with covariance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.cameras.camera import Camera
from marey.compiled.kernels import kernel

_LEAST_SPREAD = 1e-6
"""Smallest eigenvalue of the normal matrix of the rays that determines a point; chosen by hand.

It is about half the squared angle between two rays: below it the rays are parallel to within 0.08 degrees.
"""
_ITERATIONS = 20
"""Largest number of Gauss-Newton iterations; chosen by hand."""
_SMALL_STEP = 1e-10
"""Length of a step, relative to the distance from the first camera, that ends the iteration; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TriangulatedPoints:
    """Points with their uncertainty; NaN where the views do not determine a point."""

    points: Floats
    """(n, 3) [m]."""
    covariance: Floats
    """(n, 3, 3) [m2], from the stated standard deviation of the pixels."""
    residual_px: Floats
    """(n,) root mean square distance between the pixels and the projections of the point [px]."""
    views: Integers
    """(n,) number of views in which the point was measured."""

    def __post_init__(self) -> None:
        freeze_fields(self, "points", "covariance", "residual_px")
        freeze_fields(self, "views", dtype=np.int64)


def triangulate(cameras: Sequence[Camera], pixels: Floats, *, sigma_px: float | Floats) -> TriangulatedPoints:
    """Triangulate points by weighted least squares in the images.

    The initial point is the one nearest to all rays; Gauss-Newton iterations minimise the distances in the images.

    Args:
        cameras: C cameras.
        pixels: (C, n, 2) [px]; NaN in the views that did not measure a point.
        sigma_px: Standard deviation of the pixels in x and in y [px]; one number, or (C, n).

    Returns:
        The points; NaN with fewer than two views, with parallel rays, and if no point in front of the cameras fits.

    Example:
        >>> import numpy as np
        >>> import marey
        >>> rig = marey.read_cameras(marey.example_folder())
        >>> true = np.array([[0.1, 0.2, 1.0]])
        >>> pixels = np.stack([camera.project(true) for camera in rig])
        >>> found = marey.triangulate(list(rig), pixels, sigma_px=0.5)
        >>> found.points.round(6).tolist()
        [[0.1, 0.2, 1.0]]
    """
    pixels = np.asarray(pixels, float)
    sigma = np.broadcast_to(np.asarray(sigma_px, float), pixels.shape[:2])
    straight = np.stack([camera.undistort(seen) for camera, seen in zip(cameras, pixels, strict=True)])
    measured = np.asarray(np.isfinite(straight).all(axis=-1) & np.isfinite(sigma))
    points = _nearest_to_rays(cameras, straight, measured)
    weights = np.where(measured, 1 / np.where(measured, sigma, 1.0) ** 2, 0.0)
    active = np.isfinite(points[:, 0])
    for _ in range(_ITERATIONS):
        if not active.any():
            break
        step = _step(cameras, points[active], pixels[:, active], weights[:, active])
        points[active] += step
        distance = np.linalg.norm(points[active] - cameras[0].centre, axis=1)
        active[active] = np.linalg.norm(step, axis=1) > _SMALL_STEP * distance
    return _with_errors(cameras, points, pixels, weights)


def _nearest_to_rays(cameras: Sequence[Camera], straight: Floats, measured: np.ndarray) -> Floats:
    """Solve for the point with the least squared distance from the measured rays; `straight` is x/z and y/z."""
    n = straight.shape[1]
    normal, right = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for camera, seen, used in zip(cameras, straight, measured, strict=True):
        _add_rays(seen, camera.camera_from_world.rotation, camera.centre, used, normal, right)
    points = np.empty((n, 3))
    solve_normal(normal, right, _LEAST_SPREAD, points)
    return points


def _system(
    cameras: Sequence[Camera], points: Floats, pixels: Floats, weights: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the normal equations (n, 3, 3) and (n, 3), and the squared distances (C, n) [px2].

    A view that measured a point which it cannot see makes the rows of the point NaN.
    """
    n = len(points)
    normal, right, squares = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((len(cameras), n))
    for i, camera in enumerate(cameras):
        projected, slope = camera.project_with_derivative(points)
        add_view(pixels[i] - projected, slope, np.ascontiguousarray(weights[i]), normal, right, squares[i])
    return normal, right, squares


@kernel
def _add_rays(straight, rotation, centre, used, normal, right):
    """Add the equations of one camera's rays; the tests compare the points with those of a plain formula."""
    direction = np.empty(3)
    for n in range(len(straight)):
        if not used[n]:
            continue
        x, y = straight[n, 0], straight[n, 1]
        length = math.sqrt(x * x + y * y + 1.0)
        for k in range(3):
            direction[k] = (x * rotation[0, k] + y * rotation[1, k] + rotation[2, k]) / length
        for j in range(3):
            for k in range(3):
                across = (1.0 if j == k else 0.0) - direction[j] * direction[k]
                normal[n, j, k] += across
                right[n, j] += across * centre[k]


@kernel
def add_view(residual, slope, weights, normal, right, squares):
    """Add the equations of one camera's pixels for the places of points, and write their squared distances.

    Args:
        residual: (n, 2) measured pixels less projected ones [px].
        slope: (n, 2, 3) derivatives of the pixels by the places [px/m].
        weights: (n,) inverse variances of the pixels [1/px2]; zero where there is no pixel.
        normal: (n, 3, 3) normal matrices, increased.
        right: (n, 3) right-hand sides, increased.
        squares: (n,) for the squared distances [px2]; left as it is where there is no pixel.
    """
    for n in range(len(residual)):
        if not weights[n] > 0:
            continue
        x, y = residual[n, 0], residual[n, 1]
        squares[n] = x * x + y * y
        for j in range(3):
            along, down = weights[n] * slope[n, 0, j], weights[n] * slope[n, 1, j]
            right[n, j] += along * x + down * y
            for k in range(3):
                normal[n, j, k] += along * slope[n, 0, k] + down * slope[n, 1, k]


@kernel
def solve_normal(normal, right, least, out):
    """Solve normal equations of three unknowns; NaN where they are not known or do not determine them.

    Args:
        normal: (n, 3, 3) symmetric matrices.
        right: (n, 3) right-hand sides.
        least: the smallest eigenvalue must be larger than this.
        out: (n, 3) for the solutions.
    """
    for n in range(len(normal)):
        if not _factors(normal[n], least)[0]:
            out[n] = np.nan
            continue
        _, a, b, c, d, e, f = _factors(normal[n], 0.0)
        x = right[n, 0] / a
        y = (right[n, 1] - b * x) / c
        z = (right[n, 2] - d * x - e * y) / f
        out[n, 2] = z / f
        out[n, 1] = (y - e * out[n, 2]) / c
        out[n, 0] = (x - b * out[n, 1] - d * out[n, 2]) / a


@kernel
def invert_normal(normal, out):
    """Invert symmetric matrices (n, 3, 3) with positive eigenvalues; NaN where they have not."""
    for n in range(len(normal)):
        known, a, b, c, d, e, f = _factors(normal[n], 0.0)
        if not known:
            out[n] = np.nan
            continue
        # The inverse of the triangular factor, row by row.
        p, r, u = 1 / a, 1 / c, 1 / f
        q = -b * p * r
        s, t = -(d * p + e * q) * u, -e * r * u
        out[n, 0, 0] = p * p + q * q + s * s
        out[n, 1, 0] = out[n, 0, 1] = q * r + s * t
        out[n, 2, 0] = out[n, 0, 2] = s * u
        out[n, 1, 1] = r * r + t * t
        out[n, 2, 1] = out[n, 1, 2] = t * u
        out[n, 2, 2] = u * u


@kernel
def _factors(matrix, least):
    """Return the rows of the Cholesky factor of a symmetric matrix less `least` times the identity.

    The first value is false if that matrix is not known, or has an eigenvalue that is not positive.
    """
    x = matrix[0, 0] - least
    if not (x > 0 and x < np.inf):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    a = math.sqrt(x)
    b, d = matrix[1, 0] / a, matrix[2, 0] / a
    y = matrix[1, 1] - least - b * b
    if not (y > 0 and y < np.inf):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    c = math.sqrt(y)
    e = (matrix[2, 1] - b * d) / c
    z = matrix[2, 2] - least - d * d - e * e
    if not (z > 0 and z < np.inf):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    return True, a, b, c, d, e, math.sqrt(z)


def _step(cameras: Sequence[Camera], points: Floats, pixels: Floats, weights: Floats) -> Floats:
    normal, right, _ = _system(cameras, points, pixels, weights)
    step = np.empty_like(points)
    solve_normal(normal, right, 0.0, step)
    return step


def _with_errors(cameras: Sequence[Camera], points: Floats, pixels: Floats, weights: Floats) -> TriangulatedPoints:
    normal, right, squares = _system(cameras, points, pixels, weights)
    views, covariance = np.count_nonzero(weights, axis=0), np.empty_like(normal)
    invert_normal(normal, covariance)
    good = np.isfinite(covariance[:, 0, 0]) & np.isfinite(right).all(axis=1) & np.isfinite(points).all(axis=1)
    covariance[~good] = np.nan
    residual = np.sqrt(squares.sum(axis=0) / np.maximum(views, 1))
    return TriangulatedPoints(
        points=np.where(good[:, None], points, np.nan),
        covariance=covariance,
        residual_px=np.where(good, residual, np.nan),
        views=views,
    )
