"""The agreement at every lag is what the plain sums over the samples in common give."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.motion.shift_search import agreement_by_lag


def plain(a, b, p, q, lag, *, places, least):
    """One lag, sample by sample."""
    n, m = len(a), len(b)
    own, other = slice(max(0, -lag), min(n, m - lag)), slice(max(0, lag), min(m, n + lag))
    total = weight = 0.0
    for left, right in zip(a[own].T, b[other].T, strict=True):
        both = np.isfinite(left) & np.isfinite(right)
        if both.sum() >= least:
            spread = left[both].var() + right[both].var()
            total += both.sum() * np.log((left[both] - right[both]).var() / spread + 1e-9)
            weight += both.sum()
    both = np.isfinite(p[own]).all(-1) & np.isfinite(q[other]).all(-1)
    if both.sum() >= least:
        x, y = p[own], q[other]
        spread = sum(
            ((z[both[:, k], k] - z[both[:, k], k].mean(0)) ** 2).sum() for z in (x, y) for k in range(p.shape[1])
        )
        x, y = x[both], y[both]
        if places:
            x, y = x - x.mean(0), y - y.mean(0)
        left_over = ((x - y @ rotations.nearest(x.T @ y).T) ** 2).sum()
        total += both.sum() * np.log(left_over / spread + 1e-9)
        weight += both.sum()
    return total / weight, total


@pytest.mark.parametrize("places", [True, False])
def test_every_lag_is_as_the_plain_sums_give_it(rng, places):
    a, b = np.cumsum(rng.normal(size=(60, 2)), 0), np.cumsum(rng.normal(size=(45, 2)), 0)
    p, q = np.cumsum(rng.normal(size=(60, 3, 3)), 0), np.cumsum(rng.normal(size=(45, 3, 3)), 0)
    a[10:14, 0], b[30, 1], p[20:25, 1], q[7, 2] = np.nan, np.nan, np.nan, np.nan
    mean, total = agreement_by_lag((a, b), (p, q), places=places, least=12)
    lags = np.arange(-59, 45)
    for lag in range(-40, 25, 3):
        at = int(np.flatnonzero(lags == lag)[0])
        np.testing.assert_allclose(
            (mean[at], total[at]), plain(a, b, p, q, lag, places=places, least=12), rtol=1e-7, atol=1e-7
        )


def test_lags_with_too_little_in_common_carry_no_information(rng):
    a = rng.normal(size=(30, 1))
    mean, total = agreement_by_lag((a, a), (np.zeros((30, 0, 3)), np.zeros((30, 0, 3))), places=True, least=20)
    lags = np.arange(-29, 30)
    assert np.isinf(mean[np.abs(lags) > 10]).all()
    assert np.isinf(total[np.abs(lags) > 10]).all()
    assert lags[np.argmin(total)] == 0


def test_vectors_apart_have_axes_of_their_own_even_mirrored_or_along_a_line(rng):
    p = np.cumsum(rng.normal(size=(80, 2, 3)), 0)
    p[:, 1] = p[:, 1, :1] * [0.6, 0.0, 0.8]
    turns = [rotations.exp(rng.normal(size=3)) for _ in range(2)]
    q = np.stack([p[:, k] @ turns[k] for k in range(2)], axis=1)[12:70]
    q[:, 0] *= [1, 1, -1]
    none = np.zeros((80, 0)), np.zeros((58, 0))
    mean, total = agreement_by_lag(none, (p, q), places=True, least=20, apart=True)
    lags = np.arange(-79, 58)
    assert lags[np.argmin(total)] == lags[np.argmin(mean)] == -12
    assert mean.min() < np.log(1e-8)
    together, _ = agreement_by_lag(none, (p, q), places=True, least=20)
    assert together[np.argmin(mean)] > np.log(0.01)
