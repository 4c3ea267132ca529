"""Low-rank completion of noisy tracks with gaps under a Gaussian prior, and robust singular value decomposition."""

import numpy as np
import scipy.linalg

from marey.arrays import Floats, Mask

COMPLETION_RANK = 15
"""Rank, beside the translation, with which tracks are completed before they are factorised. Chosen by hand; results
were not measured against other values."""
TRACKING_RANK = 12
"""Rank, beside the translation, with which tracks are completed to compare cameras and to find outliers. Chosen by
hand; results were not measured against other values."""
_ROUNDS = 60
"""Largest number of rounds of expectation maximisation; a limit on time."""
_TOLERANCE = 1e-4
"""Rounds end when the noise variance changes by less than this fraction; a numerical tolerance."""
_LEAST_VARIANCE = 1e-12
"""Smallest noise variance, as a fraction of the variance of the kept components; keeps exact data solvable."""


def singular_vectors(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Compute U (n, k), the singular values (k,) and V' (k, m) of a matrix, k being the lesser of n and m.

    NumPy's divide-and-conquer driver fails to converge on some matrices of low rank; this driver is slower but
    converges.
    """
    u, d, vt = scipy.linalg.svd(matrix, full_matrices=False, lapack_driver="gesvd", check_finite=False)
    return np.asarray(u), np.asarray(d), np.asarray(vt)


def complete_tracks(tracks: Floats, seen: Mask, rank: int) -> tuple[Floats, float]:
    """Fit tracks by a translation and few singular vectors, and evaluate the fit everywhere ([Tipping1999], with gaps).

    Args:
        tracks: (F, 2, P), with arbitrary values where not seen.
        seen: (F, P).
        rank: Number of singular vectors beside the translation.

    Returns:
        The fit (F, 2, P), centred in each frame, and the standard deviation of a coordinate about it.
    """
    weight, known = seen.astype(float), np.where(seen[:, None], tracks, 0)
    frames, _, points = tracks.shape
    middle = known.sum(2, keepdims=True) / weight.sum(1)[:, None, None]
    left = np.where(seen[:, None], tracks - middle, 0).reshape(2 * frames, points)
    _, d, vt = singular_vectors(left)
    rank = min(rank, len(d) - 1)
    basis = vt[:rank].T * np.sqrt(points)
    spread = d[:rank] ** 2 / left.size
    floor = _LEAST_VARIANCE * float(spread.sum())
    variance, before = float((d[rank:] ** 2).sum() / left.size) + floor, np.inf
    for _ in range(_ROUNDS):
        rows, covariance = _solve_rows(known, weight, basis, variance / (spread + floor))
        square = np.einsum("fia,fib->fab", rows, rows) + 2 * variance * covariance
        basis = _solve_columns(known, weight, rows, square, variance * covariance)
        columns = np.concatenate([np.ones((points, 1)), basis], 1)
        residual = (known - rows @ columns.T) * weight[:, None]
        uncertainty = 2 * np.einsum("fab,pa,pb,fp->", covariance, columns, columns, weight, optimize=True)
        variance = (float((residual**2).sum()) + variance * uncertainty) / (2 * weight.sum()) + floor
        spread = np.einsum("faa->a", square[:, 1:, 1:]) / (2 * frames)
        if abs(before - variance) <= _TOLERANCE * variance:
            break
        before = variance
    fit = rows @ columns.T
    return fit - fit.mean(2, keepdims=True), float(np.sqrt(variance))


def _solve_rows(known: Floats, weight: Floats, basis: Floats, ridge: Floats) -> tuple[Floats, Floats]:
    """Solve for translation and weights (F, 2, 1 + r) of each frame; also their covariance over the noise variance."""
    columns = np.concatenate([np.ones((len(basis), 1)), basis], 1)
    pairs = np.einsum("pa,pb->pab", columns, columns).reshape(len(basis), -1)
    normal = (weight @ pairs).reshape(len(weight), len(ridge) + 1, -1)
    normal[:, range(1, len(ridge) + 1), range(1, len(ridge) + 1)] += ridge
    covariance = np.linalg.inv(normal)
    return np.einsum("fab,fib->fia", covariance, known @ columns), covariance


def _solve_columns(known: Floats, weight: Floats, rows: Floats, square: Floats, covariance: Floats) -> Floats:
    """Solve for the centred basis (P, r), given the frames."""
    rank = rows.shape[2] - 1
    normal = (weight.T @ square[:, 1:, 1:].reshape(len(weight), -1)).reshape(-1, rank, rank)
    normal = normal + 1e-9 * np.trace(square.sum(0)) / rank * np.eye(rank)
    right = np.einsum("fip,fia->pa", known - rows[:, :, :1] * weight[:, None], rows[:, :, 1:])
    right -= 2 * weight.T @ covariance[:, 0, 1:]
    basis = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(basis - basis.mean(0))
