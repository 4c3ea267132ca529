"""Agreement of two recordings at every shift of their clocks, computed by Fourier transforms."""

import numpy as np
from scipy import fft

from marey.arrays import Floats, Mask

_VARIANCE_FLOOR = 1e-9
"""Smallest remaining share of the variance; equal recordings agree up to rounding only."""
MINIMUM_SINGULAR_RATIO = 1e-3
"""Smallest ratio of the second to the first singular value that determines a rotation. Chosen by hand."""
_NO_VARIANCE = 1e-12
"""Ratio of the variance to the mean square below which a column is constant; numerical."""


def agreement_by_lag(
    scalars: tuple[Floats, Floats], vectors: tuple[Floats, Floats], *, places: bool, least: int, apart: bool = False
) -> tuple[Floats, Floats]:
    """Compute the disagreement of two recordings at each lag: the logarithm of the remaining share of the variance.

    Scalars may differ by a constant; vectors are aligned by the best rotation, and translation if they are positions.
    Normalisation by the variance prevents sections without motion from counting as a good fit. The mean over all
    numbers measures the quality of the fit; the sum, as in a log likelihood, measures the evidence: for a periodic
    motion it favours the lag with the longer overlap.

    Args:
        scalars: (N, K) and (M, K) with the same time step; NaN where unknown.
        vectors: (N, P, 3) and (M, P, 3).
        places: Whether the vectors are positions, which may differ by a translation.
        least: Fewest common frames of a column.
        apart: Whether each vector has axes of its own, which may be mirrored, instead of one rotation for all.

    Returns:
        Mean and sum (N + M - 1,) for lags from -(N - 1) to M - 1: sample i of the first corresponds to sample i + lag
        of the second. Infinite without common data.
    """
    n, m = len(scalars[0]), len(scalars[1])
    total, weight = np.zeros(n + m - 1), np.zeros(n + m - 1)
    for a, b in zip(scalars[0].T, scalars[1].T, strict=True):
        logs, counts = _of_scalar(a, b, least)
        total, weight = total + counts * logs, weight + counts
    count = vectors[0].shape[1]
    for own in [slice(k, k + 1) for k in range(count)] if apart else [slice(None)] * bool(count):
        pair = vectors[0][:, own], vectors[1][:, own]
        logs, counts = _of_vectors(*pair, places=places, least=least, mirrored=apart)
        total, weight = total + counts * logs, weight + counts
    known = weight > 0
    mean = np.where(known, total / np.where(known, weight, 1.0), np.inf)
    return mean, np.where(known, total, np.inf)


def _of_scalar(a: Floats, b: Floats, least: int) -> tuple[Floats, Floats]:
    """Return the logarithm and the count at each lag of one column; both 0 where it is not usable."""
    (a, seen_a), (b, seen_b) = (_centred(column) for column in (a, b))
    pair = _Lags(len(a), len(b))
    count = pair.counts(seen_a, seen_b)
    safe = np.maximum(count, 1.0)
    mean_a, mean_b = pair.sums(a, seen_b) / safe, pair.sums(seen_a, b) / safe
    square_a, square_b = pair.sums(a**2, seen_b) / safe, pair.sums(seen_a, b**2) / safe
    spread = square_a - mean_a**2 + square_b - mean_b**2
    left = square_a + square_b - 2 * pair.sums(a, b) / safe - (mean_a - mean_b) ** 2
    return _logarithm(left, spread, count, least, float((a**2).mean() + (b**2).mean()))


def _of_vectors(p: Floats, q: Floats, *, places: bool, least: int, mirrored: bool) -> tuple[Floats, Floats]:
    """Return the logarithm and the count at each lag of all vectors together."""
    seen = [np.asarray(np.isfinite(x).all(-1)) for x in (p, q)]
    p, q = (_without_mean(x, known, places=places) for x, known in zip((p, q), seen, strict=True))
    pair = _Lags(len(p), len(q))
    lags = len(p) + len(q) - 1
    count, moved, squares = np.zeros(lags), np.zeros(lags), np.zeros(lags)
    sum_p, sum_q, cross = np.zeros((lags, 3)), np.zeros((lags, 3)), np.zeros((lags, 3, 3))
    for k in range(p.shape[1]):
        known_p, known_q = (known[:, k].astype(float) for known in seen)
        own = pair.counts(known_p, known_q)
        safe = np.maximum(own, 1.0)
        own_p = np.stack([pair.sums(p[:, k, i], known_q) for i in range(3)], 1)
        own_q = np.stack([pair.sums(known_p, q[:, k, i]) for i in range(3)], 1)
        both = pair.sums((p[:, k] ** 2).sum(-1), known_q) + pair.sums(known_p, (q[:, k] ** 2).sum(-1))
        moved += both - ((own_p**2).sum(1) + (own_q**2).sum(1)) / safe
        count, squares, sum_p, sum_q = count + own, squares + both, sum_p + own_p, sum_q + own_q
        for i in range(3):
            cross[:, i] += np.stack([pair.sums(p[:, k, i], q[:, k, j]) for j in range(3)], 1)
    safe = np.maximum(count, 1.0)
    if places:
        cross = cross - sum_p[:, :, None] * sum_q[:, None] / safe[:, None, None]
        squares = squares - ((sum_p**2).sum(1) + (sum_q**2).sum(1)) / safe
    u, sizes, vt = np.linalg.svd(cross)
    if not mirrored:
        sizes = sizes * np.stack([np.ones(lags), np.ones(lags), np.sign(np.linalg.det(u @ vt))], 1)
    left = (squares - 2 * sizes.sum(1)) / safe
    logs, counts = _logarithm(left, moved / safe, count, least, float((p**2).mean() + (q**2).mean()))
    # Vectors along one line do not determine a rotation, but are aligned by every one that suits the line.
    turned = mirrored | (sizes[:, 1] > MINIMUM_SINGULAR_RATIO * sizes[:, 0])
    return np.where(turned, logs, 0.0), np.where(turned, counts, 0.0)


def _centred(column: Floats) -> tuple[Floats, Floats]:
    """Return a column minus its mean (0 where unknown), and 1 where it is known."""
    known = np.isfinite(column)
    middle = column[known].mean() if known.any() else 0.0
    return np.where(known, column - middle, 0.0), known.astype(float)


def _without_mean(vectors: Floats, known: Mask, *, places: bool) -> Floats:
    """Return vectors minus their common mean if they are positions; 0 where unknown."""
    middle = vectors[known].mean(0) if places and known.any() else np.zeros(3)
    return np.where(known[..., None], vectors - middle, 0.0)


def _logarithm(left: Floats, spread: Floats, count: Floats, least: int, size: float) -> tuple[Floats, Floats]:
    """Return the logarithm of the remaining share of the variance, and the count; both 0 where it is not usable."""
    usable = (count >= least) & (spread > _NO_VARIANCE * max(size, _NO_VARIANCE))
    share = np.maximum(left, 0.0) / np.where(usable, spread, 1.0)
    return np.where(usable, np.log(share + _VARIANCE_FLOOR), 0.0), np.where(usable, count, 0.0)


class _Lags:
    """Sums of products of two columns at every lag.

    Args:
        n: Samples of the first column.
        m: Samples of the second.
    """

    def __init__(self, n: int, m: int):
        self._n, self._lags = n, n + m - 1
        self._size = fft.next_fast_len(self._lags, real=True)

    def sums(self, a: Floats, b: Floats) -> Floats:
        """Sum a[i] b[i + lag] over i, for each lag (N + M - 1,)."""
        product = fft.rfft(a[::-1], self._size) * fft.rfft(b, self._size)
        return np.asarray(fft.irfft(product, self._size)[: self._lags])

    def counts(self, a: Floats, b: Floats) -> Floats:
        """Compute the same for flags, rounded to integers."""
        return np.round(self.sums(a, b))
