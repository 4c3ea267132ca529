"""Completion of noisy tracks with gaps by a low-rank model with a Gaussian prior, and robust singular vectors."""

import numpy as np
import scipy.linalg

from marey.arrays import Floats, Mask


def singular_vectors(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Give U (n, k), the singular values (k,) and V' (k, m), k the lesser of n and m.

    NumPy's own way (divide and conquer) gives up on some harmless matrices of low rank; this one is slower and never.
    """
    u, d, vt = scipy.linalg.svd(matrix, full_matrices=False, lapack_driver="gesvd", check_finite=False)
    return np.asarray(u), np.asarray(d), np.asarray(vt)


ROUNDS = 60
STILL = 1e-4
LEAST = 1e-12


def complete_tracks(tracks: Floats, seen: Mask, rank: int) -> tuple[Floats, float]:
    """Fit tracks by a mean and few singular vectors, and give the fit everywhere ([Tipping1999], with entries missing).

    Args:
        tracks: (F, 2, P), of any value where not seen.
        seen: (F, P).
        rank: number of singular vectors beside the translation.

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
    floor = LEAST * float(spread.sum())
    variance, before = float((d[rank:] ** 2).sum() / left.size) + floor, np.inf
    for _ in range(ROUNDS):
        rows, covariance = _solve_rows(known, weight, basis, variance / (spread + floor))
        square = np.einsum("fia,fib->fab", rows, rows) + 2 * variance * covariance
        basis = _solve_columns(known, weight, rows, square, variance * covariance)
        columns = np.concatenate([np.ones((points, 1)), basis], 1)
        residual = (known - rows @ columns.T) * weight[:, None]
        doubt = 2 * np.einsum("fab,pa,pb,fp->", covariance, columns, columns, weight, optimize=True)
        variance = (float((residual**2).sum()) + variance * doubt) / (2 * weight.sum()) + floor
        spread = np.einsum("faa->a", square[:, 1:, 1:]) / (2 * frames)
        if abs(before - variance) <= STILL * variance:
            break
        before = variance
    fit = rows @ columns.T
    return fit - fit.mean(2, keepdims=True), float(np.sqrt(variance))


def _solve_rows(known: Floats, weight: Floats, basis: Floats, ridge: Floats) -> tuple[Floats, Floats]:
    """Give translation and weights (F, 2, 1 + r) of every frame, and their covariance over the noise's variance."""
    columns = np.concatenate([np.ones((len(basis), 1)), basis], 1)
    pairs = np.einsum("pa,pb->pab", columns, columns).reshape(len(basis), -1)
    normal = (weight @ pairs).reshape(len(weight), len(ridge) + 1, -1)
    normal[:, range(1, len(ridge) + 1), range(1, len(ridge) + 1)] += ridge
    covariance = np.linalg.inv(normal)
    return np.einsum("fab,fib->fia", covariance, known @ columns), covariance


def _solve_columns(known: Floats, weight: Floats, rows: Floats, square: Floats, covariance: Floats) -> Floats:
    """Give the basis (P, r), centred, given the frames."""
    rank = rows.shape[2] - 1
    normal = (weight.T @ square[:, 1:, 1:].reshape(len(weight), -1)).reshape(-1, rank, rank)
    normal = normal + 1e-9 * np.trace(square.sum(0)) / rank * np.eye(rank)
    right = np.einsum("fip,fia->pa", known - rows[:, :, :1] * weight[:, None], rows[:, :, 1:])
    right -= 2 * weight.T @ covariance[:, 0, 1:]
    basis = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(basis - basis.mean(0))
