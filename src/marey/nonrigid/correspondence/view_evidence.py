"""Log-likelihood ratio that two tracks of two cameras show the same point.

Tracks are represented by few components in time (K, 2, P). Two properties indicate a pair. The two sides of the affine
epipolar equation agree, for any deformation. And the coordinate that the equation does not constrain is predicted
by the other camera's track, as far as the tracks of one surface span one subspace. The residuals of pairs are measured
for each component, so that lenses and perspective make the evidence weaker, not wrong.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.nonrigid.correspondence.affine_epipolar import fitted_equation

FEWEST_PAIRS = 6
"""Least number of pairs from which residuals are measured. Chosen by hand; results were not measured against other
values."""
_DIMENSIONS = 12
"""Largest dimension of the subspace in which a track predicts that of the other camera. Chosen by hand; results were
not measured against other values."""
_RIDGES = 10.0 ** np.arange(-6, 1)
"""Relative ridge penalties, of which the one with the least cross-validated residual is chosen."""
_LEAST = 1e-10
"""Least variance of tracks of unit spread; keeps exact tracks solvable."""
_FREEDOM = 6.0
"""Degrees of freedom of the t distribution of residuals, which are measured with few pairs and have outliers. Chosen by
hand; results were not measured against other values."""
_ASTRAY = 0.01
"""Assumed fraction of points that leave the subspace and cannot be predicted. Chosen by hand; results were not measured
against other values."""
_LEAST_DIRECTION = 1e-6
"""Least length of either half of an epipolar equation; with a shorter one, that camera contributes nothing."""


@dataclass(frozen=True, eq=False)
class PairTracks:
    """Tracks of two cameras with assumed pairs."""

    first: Floats
    """(K, 2, P) components of the first camera's tracks."""
    second: Floats
    """(K, 2, Q) components of the second camera's tracks."""
    rows: Integers
    """(n,) points of the first camera."""
    columns: Integers
    """(n,) their partners in the second camera."""

    def __post_init__(self) -> None:
        freeze_fields(self, "first", "second")
        freeze_fields(self, "rows", "columns", dtype=np.int64)


def pair_evidence(pairs: PairTracks, *, leniency: float = 1.0) -> Floats:
    """Compute the log-likelihood ratio (P, Q) that two tracks show the same point.

    Each of the given pairs is evaluated by the others.

    Args:
        pairs: Tracks and pairs.
        leniency: Factor of the residuals' variance; few close pairs underestimate it for the others.
    """
    equation = fitted_equation(pairs.first[:, :, pairs.rows], pairs.second[:, :, pairs.columns])
    here, there = np.hypot(*equation[:2]), np.hypot(*equation[2:])
    if min(here, there) < _LEAST_DIRECTION:
        return np.zeros((pairs.first.shape[2], pairs.second.shape[2]))
    left = np.einsum("i,kip->kp", equation[:2], pairs.first)
    right = -np.einsum("i,kip->kp", equation[2:], pairs.second)
    across_left = np.einsum("i,kip->kp", _perpendicular(equation[:2] / here), pairs.first)
    across_right = np.einsum("i,kip->kp", _perpendicular(equation[2:] / there), pairs.second)
    forth = _predicted(pairs.first, across_right, pairs.rows, pairs.columns, leniency)
    back = _predicted(pairs.second, across_left, pairs.columns, pairs.rows, leniency)
    return _along(left, right, pairs.rows, pairs.columns, leniency) + (forth + back.T) / 2


def _perpendicular(direction: Floats) -> Floats:
    return np.array([-direction[1], direction[0]])


def _log_density(away: Floats, variance: Floats) -> Floats:
    """Compute the log-density of a multivariate t distribution over the first axis, up to a constant.

    All components share one tail: an outlier in one component is likely to be one in the others.
    """
    together = 1 + np.sum(away**2 / variance, axis=0) / _FREEDOM
    volume = np.sum(np.log(np.broadcast_to(variance, away.shape)), axis=0)
    return np.asarray(-0.5 * volume - (_FREEDOM + len(away)) / 2 * np.log(together))


def _variance(away: Floats) -> Floats:
    """Estimate the variance of each component (K,) of residuals (K, n), regularised by that of all components."""
    square = np.sort(away**2, axis=1)
    # The median of the squares is robust to a few wrong pairs; that of the chi-square distribution is 0.455.
    middle = np.median(square, axis=1) / 0.455
    count = away.shape[1]
    return np.asarray((count * middle + 4 * middle.mean()) / (count + 4) * (count + 1) / (count - 1) + _LEAST)


def _along(left: Floats, right: Floats, rows: Integers, columns: Integers, leniency: float) -> Floats:
    """Compute the log-likelihood ratio (P, Q) of both sides of the equation, (K, P) and (K, Q)."""
    paired = left[:, rows] - right[:, columns]
    offset = np.median(paired, axis=1)
    away = left[:, :, None] - right[:, None, :] - offset[:, None, None]
    variance = leniency * _variance(away[:, rows, columns])
    apart = np.maximum(np.var(left, axis=1) + np.var(right, axis=1), variance)
    return _log_density(away, variance[:, None, None]) - _log_density(away, apart[:, None, None])


def _predicted(tracks: Floats, target: Floats, rows: Integers, columns: Integers, leniency: float) -> Floats:
    """Compute the log-likelihood ratio (P, Q) of a coordinate (K, Q) predicted from tracks (K, 2, P)."""
    features = _features(tracks, len(rows))
    scale = float(np.mean(features[rows] ** 2))
    fits = [_Regression(features, rows, target[:, columns].T, ridge * scale) for ridge in _RIDGES]
    fit = min(fits, key=lambda fit: float(np.log(np.median(fit.left**2, axis=0) + _LEAST).sum()))
    alone = np.maximum(np.var(target, axis=1), _LEAST)
    variance = np.minimum(leniency * _variance(fit.left.T)[:, None] * fit.inflation, alone[:, None])
    guess = np.repeat(fit.guess.T[:, :, None], target.shape[1], axis=2)
    guess[:, :, columns] = fit.guess_without()
    plain = _log_density(target - np.mean(target, axis=1)[:, None], alone[:, None])
    evidence = _log_density(target[:, None, :] - guess, variance[:, :, None]) - plain
    return np.logaddexp(evidence, np.log(_ASTRAY))


def _features(tracks: Floats, count: int) -> Floats:
    """Compute ones and the coefficients of tracks in their own subspace, (P, 1 + r)."""
    flat = tracks.reshape(-1, tracks.shape[2])
    _, d, vt = np.linalg.svd(flat - flat.mean(1, keepdims=True), full_matrices=False)
    rank = min(_DIMENSIONS, count // 2, len(d))
    return np.concatenate([np.ones((len(vt.T), 1)), vt[:rank].T * d[:rank]], axis=1)


class _Regression:
    """Ridge regression on pairs with leave-one-out predictions."""

    def __init__(self, features: Floats, rows: Integers, wanted: Floats, ridge: float):
        """Solve for features (P, r) and targets (n, K) of the n pairs."""
        known = features[rows]
        penalty = ridge * len(rows) * np.eye(known.shape[1])
        penalty[0, 0] = 0
        inverse = np.linalg.inv(known.T @ known + penalty)
        self.rows, self.wanted = rows, wanted
        self.hat = features @ inverse @ known.T
        self.fitted = self.hat @ wanted
        self.own = np.minimum(np.diagonal(self.hat[rows]), 1 - 1e-6)
        self.error = wanted - self.fitted[rows]
        self.guess = self.fitted.copy()
        """(P, K) prediction, for points in pairs by the other pairs."""
        self.guess[rows] = wanted - self.error / (1 - self.own)[:, None]
        self.inflation = 1 + np.einsum("pi,ij,pj->p", features, inverse, features)
        """(P,) factor of the prediction's variance."""
        self.inflation[rows] = 1 / (1 - self.own)
        self.left = (wanted - self.guess[rows]) / np.sqrt(self.inflation[rows])[:, None]
        """(n, K) leave-one-out residual of each pair, over the root of that factor."""

    def guess_without(self) -> Floats:
        """Compute predictions (K, P, n) without the point's own pair and without the n-th pair."""
        away = self.error / (1 - self.own)[:, None]
        without = self.fitted[:, None] - self.hat[:, :, None] * away
        cross = self.hat[self.rows]
        apart = np.maximum(np.outer(1 - self.own, 1 - self.own) - cross * cross.T, 1e-9)
        both = (1 - self.own)[None, :, None] * self.error[:, None] + cross[:, :, None] * self.error
        pairs = self.wanted[:, None] - both / apart[:, :, None]
        everyone = np.arange(len(self.rows))
        pairs[everyone, everyone] = self.guess[self.rows]
        without[self.rows] = pairs
        return np.moveaxis(without, 2, 0)
