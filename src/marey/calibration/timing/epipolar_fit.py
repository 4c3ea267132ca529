"""The fundamental matrix that suits most points of two cameras, some of which are wrong ([Hartley1997]).

Points are pixels that were shifted and scaled to about one, so that their products are of similar size.
"""

import math
from functools import lru_cache

import numpy as np

from marey.arrays import Floats, Integers
from marey.compiled.kernels import kernel

_SAMPLES, _POINTS = 96, 160
"""Number of fundamental matrices that are tried, each from eight points, and of points with which they are compared: of
30 % wrong points, a sample is free with a probability of 6 %. Chosen by hand."""
_ROUNDS = 6
"""Number of times that the best matrix is fitted again to the points near it; chosen by hand."""


def epipolar_fit(first: Floats, second: Floats) -> tuple[Floats, float]:
    """Find the fundamental matrix that suits most points of two cameras.

    The matrix with the least median of many from eight points each is fitted again to the points near it.

    Args:
        first: (n, 2) points of a camera.
        second: (n, 2) those of another one.

    Returns:
        The matrix (9,), and the median of Sampson's distances, in units of the points.
    """
    rows = _evenly(len(first), 4 * _POINTS)
    first, second = (np.ascontiguousarray(points[rows], float) for points in (first, second))
    few = _evenly(len(rows), _POINTS)
    matrix = _best_of_samples(first, second, _samples(len(rows)), first[few], second[few])
    return _fitted_again(matrix, first, second)


def point_distances(matrix: Floats, first: Floats, second: Floats) -> Floats:
    """Return Sampson's distances (...) of points (..., 2) of two cameras for a fundamental matrix (9,)."""
    flat = (np.ascontiguousarray(points.reshape(-1, 2), float) for points in (first, second))
    return np.asarray(_distances(matrix, *flat).reshape(first.shape[:-1]))


@lru_cache(maxsize=256)
def _evenly(count: int, most: int) -> Integers:
    """Return at most some indices that are distributed evenly."""
    found = np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))
    found.flags.writeable = False
    return found


@lru_cache(maxsize=256)
def _samples(count: int) -> Integers:
    """Return the eight points of each sample; always the same, so that the same command gives the same result."""
    found = np.random.default_rng(0).random((_SAMPLES, count)).argpartition(8, axis=1)[:, :8]
    found.flags.writeable = False
    return found


@kernel
def _best_of_samples(first, second, samples, few, few_second):
    """Return the matrix (9,) from eight points (S, 8) that has the least median distance of a few points (m, 2)."""
    best, least = np.zeros(9), np.inf
    equations = np.empty((8, 9))
    distances = np.empty(len(few))
    for s in range(len(samples)):
        for row in range(8):
            i = samples[s, row]
            _equation(first[i, 0], first[i, 1], second[i, 0], second[i, 1], equations[row])
        matrix = null_vector(equations)
        above = 0
        for i in range(len(few)):
            distances[i] = _sampson(matrix, few[i, 0], few[i, 1], few_second[i, 0], few_second[i, 1])
            above += distances[i] >= least
            if 2 * above > len(few):
                break
        if 2 * above <= len(few):
            median = np.median(distances)
            if median < least:
                best, least = matrix, median
    return best


@kernel
def _fitted_again(matrix, first, second):
    """Return the matrix after fits with robust weights, the best of all rounds, and its median distance."""
    best = chosen = matrix
    distances = _distances(best, first, second)
    median = np.median(distances)
    least, row = median, np.empty(9)
    for _ in range(_ROUNDS):
        scale = 1.5 * median + 1e-6
        square = np.zeros((9, 9))
        for i in range(len(first)):
            slope = _slope_square(best, first[i, 0], first[i, 1], second[i, 0], second[i, 1])
            weight = 1.0 / ((1.0 + (distances[i] / scale) ** 2) * (slope + 1e-12))
            _equation(first[i, 0], first[i, 1], second[i, 0], second[i, 1], row)
            for a in range(9):
                for b in range(a + 1):
                    square[a, b] += weight * row[a] * row[b]
        best = np.linalg.eigh(square)[1][:, 0].copy()
        distances = _distances(best, first, second)
        median = np.median(distances)
        if median < least:
            least, chosen = median, best
    return chosen, least


@kernel(inline="always")
def _equation(x, y, u, v, row):
    """Write the coefficients (9,) of the fundamental matrix in the epipolar constraint of two points."""
    row[0], row[1], row[2] = u * x, u * y, u
    row[3], row[4], row[5] = v * x, v * y, v
    row[6], row[7], row[8] = x, y, 1.0


@kernel(inline="always")
def _slope_square(matrix, x, y, u, v):
    """Return the squared length of the slope of the epipolar constraint with respect to both points."""
    line = matrix[0] * x + matrix[1] * y + matrix[2], matrix[3] * x + matrix[4] * y + matrix[5]
    back = matrix[0] * u + matrix[3] * v + matrix[6], matrix[1] * u + matrix[4] * v + matrix[7]
    return line[0] ** 2 + line[1] ** 2 + back[0] ** 2 + back[1] ** 2


@kernel(inline="always")
def _sampson(matrix, x, y, u, v):
    """Return Sampson's distance of two points."""
    product = u * (matrix[0] * x + matrix[1] * y + matrix[2]) + v * (matrix[3] * x + matrix[4] * y + matrix[5])
    product += matrix[6] * x + matrix[7] * y + matrix[8]
    return abs(product) / math.sqrt(max(_slope_square(matrix, x, y, u, v), 1e-30))


@kernel
def _distances(matrix, first, second):
    """Return Sampson's distances (n,) of points (n, 2)."""
    out = np.empty(len(first))
    for i in range(len(first)):
        out[i] = _sampson(matrix, first[i, 0], first[i, 1], second[i, 0], second[i, 1])
    return out


@kernel
def null_vector(equations):
    """Return the unit vector (n + 1,) for which n homogeneous equations (n, n + 1) are zero.

    The equations are eliminated with complete pivoting. Dependent ones leave any of the vectors that satisfy them.
    """
    rows, columns = equations.shape
    work, order = equations.copy(), np.arange(columns)
    rank = rows
    for k in range(rows):
        best, at, column = 0.0, k, k
        for i in range(k, rows):
            for j in range(k, columns):
                if abs(work[i, j]) > best:
                    best, at, column = abs(work[i, j]), i, j
        if best == 0.0:
            rank = k
            break
        for j in range(columns):
            work[k, j], work[at, j] = work[at, j], work[k, j]
        for i in range(rows):
            work[i, k], work[i, column] = work[i, column], work[i, k]
        order[k], order[column] = order[column], order[k]
        for i in range(k + 1, rows):
            factor = work[i, k] / work[k, k]
            for j in range(k, columns):
                work[i, j] -= factor * work[k, j]
    solved = np.zeros(columns)
    solved[rank] = 1.0
    for k in range(rank - 1, -1, -1):
        total = 0.0
        for j in range(k + 1, columns):
            total += work[k, j] * solved[j]
        solved[k] = -total / work[k, k]
    out = np.empty(columns)
    out[order] = solved / np.sqrt(np.sum(solved**2))
    return out
