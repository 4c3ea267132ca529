"""Affine epipolar equation a x + b y + c x' + d y' = e(t) between the images of fixed, unknown cameras ([Shapiro1995]).

Tracks are represented by few components in time (K, 2, P) instead of frames: the equation is linear and also holds for
these.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import linear_sum_assignment

from marey.arrays import Floats, Integers

_TINY = 1e-12
"""Least spread by which square distances are divided; keeps points without motion harmless."""


@dataclass(frozen=True, kw_only=True)
class EpipolarSettings:
    """Settings of the search for the affine epipolar equation.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.
    """

    bases: int = 24
    """Number of pairs of points of the first camera from which hypotheses are generated: enough that the second camera
    sees one of them, even if it shares only half of the points."""
    kept: int = 40
    """Number of hypotheses per base that are evaluated with all points."""
    rounds: int = 20
    """Largest number of rounds of assignment and fitting."""
    floor: float = 1e-4
    """Square distances below this fraction of the spread count alike in the first evaluation."""
    outlying: float = 9.0
    """A pair is rejected where its square distance is more than this times the median of the nearest ones."""
    unlike: float = -10.0
    """Pairs whose appearance has a lower log-likelihood ratio are excluded [natural logarithm]."""


class EpipolarHypothesis(NamedTuple):
    """An epipolar equation with the pairs of points that satisfy it."""

    equation: Floats
    """(4,) a, b, c, d of unit length."""
    rows: Integers
    """(n,) points of the first camera."""
    columns: Integers
    """(n,) their partners in the second camera."""
    distance: float
    """Median square distance of the pairs over the spread along the equation's direction."""


def epipolar_hypotheses(
    first: Floats,
    second: Floats,
    *,
    count: int,
    looks: Floats | None = None,
    seed: int = 0,
    settings: EpipolarSettings = EpipolarSettings(),
) -> list[EpipolarHypothesis]:
    """Find equations that many pairs of points satisfy, without known pairs.

    Two points seen by both cameras determine the equation in closed form, since e(t) cancels in their difference. Some
    pairs of points of the first camera are therefore tried with all pairs of the second; the hypotheses with the best
    agreement of the other points are refined by assignment and fitting in turn.

    Args:
        first: (K, 2, P) tracks of one camera.
        second: (K, 2, Q) tracks of another camera; both of about unit spread.
        count: Number of hypotheses that are refined.
        looks: (P, Q) log-likelihood ratio that two points are the same, from their appearance.
        seed: Seed of the random choice of bases.
        settings: Tuned constants.

    Returns:
        Distinct hypotheses, the one of least distance first.
    """
    alike = np.zeros((first.shape[2], second.shape[2])) if looks is None else looks
    tried = []
    for p, far in _bases(first, seed, settings.bases):
        for equation, q in _from_base(first, second, p, far, alike, settings.kept):
            shifted, other = first - first[:, :, p, None], second - second[:, :, q, None]
            tried.append((_support(equation, shifted, other, alike, settings.floor), equation, p, q))
    tried.sort(key=lambda item: item[0])
    settled: list[EpipolarHypothesis] = []
    for _, equation, p, q in tried[:count]:
        found = _refined(equation, first, second, (first[:, :, p], second[:, :, q]), alike, settings)
        if found is not None and not any(same_pairs(found, other) for other in settled):
            settled.append(found)
    return sorted(settled, key=lambda found: found.distance)


class _PointPairs(Protocol):
    @property
    def rows(self) -> Integers: ...
    @property
    def columns(self) -> Integers: ...


def same_pairs(one: _PointPairs, other: _PointPairs) -> bool:
    """Return whether two results have the same pairs of points: their `rows` and `columns` agree."""
    return np.array_equal(one.rows, other.rows) and np.array_equal(one.columns, other.columns)


def _bases(first: Floats, seed: int, most: int) -> list[tuple[int, int]]:
    """Select pairs of points of the first camera that are far apart."""
    random, count = np.random.default_rng(seed), first.shape[2]
    bases = []
    for p in random.permutation(count)[:most]:
        away = np.sum((first - first[:, :, p, None]) ** 2, axis=(0, 1))
        bases.append((int(p), int(random.choice(np.argsort(away)[count // 2 :]))))
    return bases


def _from_base(first: Floats, second: Floats, p: int, far: int, looks: Floats, kept: int) -> list[tuple[Floats, int]]:
    """Compute the equations that the difference of two points satisfies best, for the best partners of both."""
    own = first[:, :, far] - first[:, :, p]
    apart = second[:, :, None, :] - second[:, :, :, None]
    count = second.shape[2]
    square = np.empty((count, count, 4, 4))
    square[..., :2, :2] = own.T @ own
    square[..., :2, 2:] = np.einsum("ki,kjqr->qrij", own, apart, optimize=True)
    square[..., 2:, :2] = np.swapaxes(square[..., :2, 2:], 2, 3)
    square[..., 2:, 2:] = np.einsum("kiqr,kjqr->qrij", apart, apart, optimize=True)
    values, vectors = np.linalg.eigh(square)
    equations = vectors[..., 0]
    along = np.einsum("qri,ij,qrj->qr", equations[..., :2], own.T @ own, equations[..., :2])
    share = np.log(np.maximum(values[..., 0], 1e-15) / np.maximum(along, 1e-12))
    share -= looks[p][:, None] + looks[far]
    share[np.arange(count), np.arange(count)] = np.inf
    best = np.argsort(share, axis=None)[:kept]
    return [(equations[q, r], int(q)) for q, r in zip(*np.unravel_index(best, share.shape), strict=True)]


def _sides(equation: Floats, first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Compute both sides of a x + b y = -(c x' + d y') for all points, (K, P) and (K, Q)."""
    return np.einsum("i,kip->kp", equation[:2], first), -np.einsum("i,kip->kp", equation[2:], second)


def square_distances(left: Floats, right: Floats) -> Floats:
    """Compute the square distances (P, Q) between columns (K, P) and (K, Q)."""
    square = np.sum(left**2, 0)[:, None] + np.sum(right**2, 0) - 2 * left.T @ right
    return np.asarray(np.maximum(square, 0))


def _spread(left: Floats, right: Floats) -> float:
    """Compute the variance along the equation's direction, the smaller of both cameras."""
    return float(min(np.var(left, axis=1).sum(), np.var(right, axis=1).sum()))


def _support(equation: Floats, first: Floats, second: Floats, looks: Floats, floor: float) -> float:
    """Compute the mean logarithm of the distances to the nearest possible partners; less is better."""
    left, right = _sides(equation, first, second)
    square = np.log(square_distances(left, right) / max(_spread(left, right), _TINY) + floor) - looks
    return float(np.minimum(square.min(1), 0).mean() + np.minimum(square.min(0), 0).mean())


def _refined(
    equation: Floats,
    first: Floats,
    second: Floats,
    origins: tuple[Floats, Floats],
    looks: Floats,
    settings: EpipolarSettings,
) -> EpipolarHypothesis | None:
    """Assign partners and fit the equation in turn until convergence; None where too few pairs remain."""
    here, there = origins
    before: tuple[Integers, Integers] | None = None
    for _ in range(settings.rounds):
        left, right = _sides(equation, first - here[..., None], second - there[..., None])
        square = square_distances(left, right)
        masked = np.where(looks > settings.unlike, square, np.inf)
        nearest = np.concatenate([masked.min(0), masked.min(1)])
        limit = settings.outlying * float(np.median(nearest[np.isfinite(nearest)])) + 1e-15
        cost = np.minimum(masked / limit, 1) * settings.outlying / 2 - looks
        rows, columns = linear_sum_assignment(cost)
        good = masked[rows, columns] < limit
        rows, columns = rows[good], columns[good]
        if len(rows) < 5:
            return None
        distance = float(np.median(square[rows, columns])) / max(_spread(left, right), _TINY)
        if before is not None and np.array_equal(before[0], rows) and np.array_equal(before[1], columns):
            break
        before = rows, columns
        here, there = first[:, :, rows].mean(2), second[:, :, columns].mean(2)
        equation = fitted_equation(first[:, :, rows], second[:, :, columns])
    return EpipolarHypothesis(equation, rows, columns, distance)


def fitted_equation(first: Floats, second: Floats) -> Floats:
    """Fit the equation (4,) to pairs of points (K, 2, n), with free e(t)."""
    both = np.concatenate([first, second], axis=1)
    both = both - both.mean(2, keepdims=True)
    return np.linalg.eigh(np.einsum("kip,kjp->ij", both, both, optimize=True))[1][:, 0]
