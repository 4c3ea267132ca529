"""How much more probable it is that two tracks of two cameras show one point than that they show two.

Tracks are given as few components in time (K, 2, P). Two things speak for a pair. Its two sides of the affine epipolar
equation agree; this holds whatever the surface does. And the coordinate that the equation leaves free lies where the
other camera's track foretells it, as far as tracks of one surface span one subspace. What pairs leave of both is
measured component by component, so that lenses and perspective make the evidence weaker, not wrong.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.nonrigid.correspondence.affine_epipolar import fitted_equation

FEWEST_PAIRS = 6
"""Fewer pairs tell nothing about how far pairs lie apart."""
_DIMENSIONS = 12
"""Of the subspace in which a track foretells the other camera's."""
_RIDGES = 10.0 ** np.arange(-6, 1)
_LEAST = 1e-10
"""Least variance, of tracks of unit spread: exact tracks shall not divide by nothing."""
_FREEDOM = 6.0
"""Degrees of freedom of the t distribution of what pairs leave: measured with few pairs, and some lie further off."""


_ASTRAY = 0.01
"""Share of the points that leave the subspace, so that nothing can be foretold of them."""


@dataclass(frozen=True, eq=False)
class PairTracks:
    """The tracks of two cameras, and who is thought to be whose partner."""

    first: Floats
    """(K, 2, P)."""
    second: Floats
    """(K, 2, Q)."""
    rows: Integers
    """(n,) of the first camera."""
    columns: Integers
    """(n,) of the second."""


def pair_evidence(pairs: PairTracks, *, leniency: float = 1.0) -> Floats:
    """Give the logarithm (P, Q) of how much more probable one point is than two.

    Each pair among those given is judged by the others.

    Args:
        pairs: Tracks and pairs.
        leniency: Factor of the variance of what pairs leave: a few tight pairs are hard judges of the rest.
    """
    equation = fitted_equation(pairs.first[:, :, pairs.rows], pairs.second[:, :, pairs.columns])
    here, there = np.hypot(*equation[:2]), np.hypot(*equation[2:])
    if min(here, there) < 1e-6:
        return np.zeros((pairs.first.shape[2], pairs.second.shape[2]))
    left = np.einsum("i,kip->kp", equation[:2], pairs.first)
    right = -np.einsum("i,kip->kp", equation[2:], pairs.second)
    across_left = np.einsum("i,kip->kp", _perpendicular(equation[:2] / here), pairs.first)
    across_right = np.einsum("i,kip->kp", _perpendicular(equation[2:] / there), pairs.second)
    forth = _foretold(pairs.first, across_right, pairs.rows, pairs.columns, leniency)
    back = _foretold(pairs.second, across_left, pairs.columns, pairs.rows, leniency)
    return _along(left, right, pairs.rows, pairs.columns, leniency) + (forth + back.T) / 2


def _perpendicular(direction: Floats) -> Floats:
    return np.array([-direction[1], direction[0]])


def _log_density(away: Floats, variance: Floats) -> Floats:
    """Give the logarithm of the density of the t distribution over the first axis, up to a constant.

    It is that of all components together: a point that lies off in one lies off in others, too.
    """
    together = 1 + np.sum(away**2 / variance, axis=0) / _FREEDOM
    volume = np.sum(np.log(np.broadcast_to(variance, away.shape)), axis=0)
    return np.asarray(-0.5 * volume - (_FREEDOM + len(away)) / 2 * np.log(together))


def _variance(away: Floats) -> Floats:
    """Give the variance of each component (K,) of what pairs (K, n) leave, steadied by that of all components."""
    square = np.sort(away**2, axis=1)
    # The middle of the squares, so that a few wrong pairs do not count; 0.455 is that of the chi-square distribution.
    middle = np.median(square, axis=1) / 0.455
    count = away.shape[1]
    return np.asarray((count * middle + 4 * middle.mean()) / (count + 4) * (count + 1) / (count - 1) + _LEAST)


def _along(left: Floats, right: Floats, rows: Integers, columns: Integers, leniency: float) -> Floats:
    """Compare both sides of the equation, (K, P) and (K, Q)."""
    paired = left[:, rows] - right[:, columns]
    offset = np.median(paired, axis=1)
    away = left[:, :, None] - right[:, None, :] - offset[:, None, None]
    variance = leniency * _variance(away[:, rows, columns])
    apart = np.maximum(np.var(left, axis=1) + np.var(right, axis=1), variance)
    return _log_density(away, variance[:, None, None]) - _log_density(away, apart[:, None, None])


def _foretold(tracks: Floats, target: Floats, rows: Integers, columns: Integers, leniency: float) -> Floats:
    """Compare a coordinate of the other camera (K, Q) with what one camera's tracks (K, 2, P) say about it."""
    features = _features(tracks, len(rows))
    scale = float(np.mean(features[rows] ** 2))
    fits = [_Regression(features, rows, target[:, columns].T, ridge * scale) for ridge in _RIDGES]
    fit = min(fits, key=lambda fit: float(np.log(np.median(fit.left**2, axis=0) + _LEAST).sum()))
    alone = np.maximum(np.var(target, axis=1), _LEAST)
    variance = np.minimum(leniency * _variance(fit.left.T)[:, None] * fit.doubt, alone[:, None])
    guess = np.repeat(fit.guess.T[:, :, None], target.shape[1], axis=2)
    guess[:, :, columns] = fit.guess_without()
    plain = _log_density(target - np.mean(target, axis=1)[:, None], alone[:, None])
    evidence = _log_density(target[:, None, :] - guess, variance[:, :, None]) - plain
    return np.logaddexp(evidence, np.log(_ASTRAY))


def _features(tracks: Floats, count: int) -> Floats:
    """Give the coefficients (P, 1 + r) of tracks in their own subspace, and a one."""
    flat = tracks.reshape(-1, tracks.shape[2])
    _, d, vt = np.linalg.svd(flat - flat.mean(1, keepdims=True), full_matrices=False)
    rank = min(_DIMENSIONS, count // 2, len(d))
    return np.concatenate([np.ones((len(vt.T), 1)), vt[:rank].T * d[:rank]], axis=1)


class _Regression:
    """Ridge regression on pairs, in which no pair has a say about itself."""

    def __init__(self, features: Floats, rows: Integers, wanted: Floats, ridge: float):
        """Solve it for features (P, r) and the n pairs' targets (n, K)."""
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
        """(P, K) what is foretold; of points in pairs by the other pairs."""
        self.guess[rows] = wanted - self.error / (1 - self.own)[:, None]
        self.doubt = 1 + np.einsum("pi,ij,pj->p", features, inverse, features)
        """(P,) factor of its variance."""
        self.doubt[rows] = 1 / (1 - self.own)
        self.left = (wanted - self.guess[rows]) / np.sqrt(self.doubt[rows])[:, None]
        """(n, K) what the others' guess leaves of each pair, over the root of that factor."""

    def guess_without(self) -> Floats:
        """Give what is foretold (K, P, n) when neither the point's own pair nor the n-th one has a say."""
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
