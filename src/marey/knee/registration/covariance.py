"""Covariance of a registration whose residuals are spatially correlated."""

import numpy as np
from scipy import sparse
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.geometry.vectors import unit_or_zero

LENGTHS_MM = (0.7, 1.5, 3.0, 5.0, 8.0, 12.0, 18.0)
"""Residuals are a sum of parts that are smooth over these lengths [mm], and of one that is independent at each point;
chosen by hand."""
_BIN_MM = 1.0
"""Width [mm] of the bins of distance in which products of residuals are averaged; chosen by hand."""
_FAR_MM = 30.0
"""Largest distance [mm] of pairs that are used: the motion has removed correlation over longer distances."""
_POINTS = 1000
"""Number of points whose pairs are used; chosen by hand."""
_SMOOTH_MM = 4.0
"""Standard deviation [mm] of the smoothing of normals, which removes roughness; chosen by hand."""


def gradient_covariance(places_mm: Floats, deviations: Floats, jacobian: Floats) -> Floats:
    """Return the covariance (6, 6) of jacobian.T @ deviations, for deviations that are correlated over any length.

    The mean product of the deviations at two points, as a function of their distance, is modelled by a sum of Gaussians
    of `LENGTHS_MM`, whose shares are found by non-negative least squares. The part of the deviations that the fit has
    removed is removed from each Gaussian as well.

    Args:
        places_mm: (N, 3).
        deviations: (N,) weighted residuals after the fit.
        jacobian: (N, 6) derivatives with respect to the fitted parameters.
    """
    chosen = np.random.default_rng(0).permutation(len(places_mm))[:_POINTS]
    slopes, left = jacobian[chosen], deviations[chosen]
    apart = np.linalg.norm(places_mm[chosen][:, None] - places_mm[chosen], axis=2)
    parts = [np.eye(len(chosen)), *(np.exp(-0.5 * (apart / length) ** 2) for length in LENGTHS_MM)]
    bins = np.where(apart < _FAR_MM, 1 + (apart / _BIN_MM).astype(int), 0)
    np.fill_diagonal(bins, bins.max() + 1)
    fitted = np.linalg.qr(slopes / np.maximum(np.linalg.norm(slopes, axis=0), 1e-12))[0]
    table = np.stack([_by_distance(_less_fit(part, fitted), bins) for part in parts], 1)
    seen = _by_distance(np.outer(left, left), bins)
    weight = np.sqrt(np.bincount(bins.ravel()))
    weight[0] = 0.0
    shares = nnls(weight[:, None] * table, weight * seen)[0]
    # The chosen points represent all: the number of pairs grows with the square of the number of points.
    more = len(places_mm) / len(chosen)
    together = sum(share * (slopes.T @ part @ slopes) for share, part in zip(shares[1:], parts[1:], strict=True))
    return np.asarray(more * shares[0] * slopes.T @ slopes + more**2 * together)


def _less_fit(matrix: Floats, fitted: Floats) -> Floats:
    """Remove from a covariance (N, N) what a fit of columns (N, 6) removes."""
    half = matrix - fitted @ (fitted.T @ matrix)
    return np.asarray(half - (half @ fitted) @ fitted.T)


def _by_distance(matrix: Floats, bins: Integers) -> Floats:
    """Return the mean of a matrix's entries in each bin."""
    flat = bins.ravel()
    return np.asarray(np.bincount(flat, matrix.ravel()) / np.maximum(np.bincount(flat), 1))


def bounded_stiffness(measured: Floats, supposed: Floats) -> Floats:
    """Return a measured stiffness (6, 6), limited to between 20 % and 200 % of the computed one."""
    scale = np.sqrt(np.maximum(np.diag(supposed), 1e-12 * np.diag(supposed).max() + 1e-300))
    values, vectors = np.linalg.eigh(supposed / np.outer(scale, scale))
    root = vectors * np.sqrt(np.maximum(values, 1e-12 * values.max()))
    inverse = np.linalg.inv(root)
    shares, turns = np.linalg.eigh(inverse @ (measured / np.outer(scale, scale)) @ inverse.T)
    back = root @ turns
    return np.asarray((back * np.clip(shares, 0.2, 2.0)) @ back.T * np.outer(scale, scale))


def smoothed_normals(places_mm: Floats, normals: Floats) -> Floats:
    """Return the mean normals (N, 3) about each point: those of the bone without its roughness."""
    summed = np.empty_like(normals)
    tree = cKDTree(places_mm)
    for part in np.array_split(np.arange(len(places_mm)), max(len(places_mm) // 1000, 1)):
        pairs = cKDTree(places_mm[part]).sparse_distance_matrix(tree, 2 * _SMOOTH_MM, output_type="coo_matrix")
        near = np.exp(-0.5 * (pairs.data / _SMOOTH_MM) ** 2)
        summed[part] = sparse.coo_matrix((near, (pairs.row, pairs.col)), shape=pairs.shape) @ normals
    return unit_or_zero(summed)
