"""The equation of fixed, unknown cameras between their pictures, a x + b y + c x' + d y' = e(t) ([Shapiro1995]).

Tracks are given as few components in time (K, 2, P) rather than frames: the equation is linear and holds for them too.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from marey.arrays import Floats, Integers

_BASES = 24
"""Pairs of points of the first camera from which hypotheses begin: enough that one is seen by the second camera, even
where that shares but half of the points."""
_KEPT = 40
"""Hypotheses a base that are tried on all points."""
_ROUNDS = 20
_FLOOR = 1e-4
"""Square distances below this share of the spread are all alike good at first."""
_OUTLYING = 9.0
"""A pair whose square distance is so many times the median of the nearest ones is none."""

_UNLIKE = -10.0
"""Points that look less alike than this are no pair [natural logarithm]."""


class Epipolar(NamedTuple):
    """A hypothesis: the equation, and who satisfies it with whom."""

    equation: Floats
    """(4,) a, b, c, d of unit length."""
    rows: Integers
    """(n,) points of the first camera."""
    columns: Integers
    """(n,) their partners in the second."""
    distance: float
    """Median square distance of the pairs over the spread along the equation's direction."""


def epipolar_hypotheses(
    first: Floats, second: Floats, *, count: int, looks: Floats | None = None, seed: int = 0
) -> list[Epipolar]:
    """Find equations that satisfy many pairs of points, without knowing which pairs.

    Two points seen by both cameras give the equation in closed form, for their difference needs no e(t). So
    some pairs of points of the first camera are tried with all pairs of the second; what most other points
    agree with is kept, and settled by assignment and refit in turn.

    Args:
        first: (K, 2, P) tracks of one camera.
        second: (K, 2, Q) of another one; both of about unit spread.
        count: How many hypotheses are settled.
        looks: (P, Q) logarithm of how much more alike points look than chance, for one and the same.
        seed: Of the choice of bases.

    Returns:
        Hypotheses that differ, the one of least distance first.
    """
    alike = np.zeros((first.shape[2], second.shape[2])) if looks is None else looks
    tried = []
    for p, far in _bases(first, seed):
        for equation, q in _from_base(first, second, p, far, alike):
            shifted, other = first - first[:, :, p, None], second - second[:, :, q, None]
            tried.append((_support(equation, shifted, other, alike), equation, p, q))
    tried.sort(key=lambda item: item[0])
    settled: list[Epipolar] = []
    for _, equation, p, q in tried[:count]:
        found = _settle(equation, first, second, first[:, :, p], second[:, :, q], alike)
        if found is not None and not any(_same(found, other) for other in settled):
            settled.append(found)
    return sorted(settled, key=lambda found: found.distance)


def _same(one: Epipolar, other: Epipolar) -> bool:
    return np.array_equal(one.rows, other.rows) and np.array_equal(one.columns, other.columns)


def _bases(first: Floats, seed: int) -> list[tuple[int, int]]:
    """Choose pairs of points of the first camera, rather far apart."""
    random, count = np.random.default_rng(seed), first.shape[2]
    bases = []
    for p in random.permutation(count)[:_BASES]:
        away = np.sum((first - first[:, :, p, None]) ** 2, axis=(0, 1))
        bases.append((int(p), int(random.choice(np.argsort(away)[count // 2 :]))))
    return bases


def _from_base(first: Floats, second: Floats, p: int, far: int, looks: Floats) -> list[tuple[Floats, int]]:
    """Give the equations that the difference of two points satisfies best, for the best partners of both."""
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
    best = np.argsort(share, axis=None)[:_KEPT]
    return [(equations[q, r], int(q)) for q, r in zip(*np.unravel_index(best, share.shape), strict=True)]


def _sides(equation: Floats, first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Give both sides of a x + b y = -(c x' + d y') for all points, (K, P) and (K, Q)."""
    return np.einsum("i,kip->kp", equation[:2], first), -np.einsum("i,kip->kp", equation[2:], second)


def square_distances(left: Floats, right: Floats) -> Floats:
    """Give the square distances (P, Q) between columns (K, P) and (K, Q)."""
    square = np.sum(left**2, 0)[:, None] + np.sum(right**2, 0) - 2 * left.T @ right
    return np.maximum(square, 0)


def _spread(left: Floats, right: Floats) -> float:
    """Give the variance along the equation's direction, the smaller of both cameras."""
    return float(min(np.var(left, axis=1).sum(), np.var(right, axis=1).sum()))


def _support(equation: Floats, first: Floats, second: Floats, looks: Floats) -> float:
    """Say how far points are from the nearest possible partner, in logarithms; less is better."""
    left, right = _sides(equation, first, second)
    square = np.log(square_distances(left, right) / max(_spread(left, right), 1e-12) + _FLOOR) - looks
    return float(np.minimum(square.min(1), 0).mean() + np.minimum(square.min(0), 0).mean())


def _settle(
    equation: Floats, first: Floats, second: Floats, here: Floats, there: Floats, looks: Floats
) -> Epipolar | None:
    """Assign partners and refit the equation in turn until nothing changes; None where nothing is left."""
    before: tuple[Integers, Integers] | None = None
    for _ in range(_ROUNDS):
        left, right = _sides(equation, first - here[..., None], second - there[..., None])
        square = square_distances(left, right)
        masked = np.where(looks > _UNLIKE, square, np.inf)
        nearest = np.concatenate([masked.min(0), masked.min(1)])
        limit = _OUTLYING * float(np.median(nearest[np.isfinite(nearest)])) + 1e-15
        cost = np.minimum(masked / limit, 1) * _OUTLYING / 2 - looks
        rows, columns = linear_sum_assignment(cost)
        good = masked[rows, columns] < limit
        rows, columns = rows[good], columns[good]
        if len(rows) < 5:
            return None
        distance = float(np.median(square[rows, columns])) / max(_spread(left, right), 1e-12)
        if before is not None and np.array_equal(before[0], rows) and np.array_equal(before[1], columns):
            break
        before = rows, columns
        here, there = first[:, :, rows].mean(2), second[:, :, columns].mean(2)
        equation = fitted_equation(first[:, :, rows], second[:, :, columns])
    return Epipolar(equation, rows, columns, distance)


def fitted_equation(first: Floats, second: Floats) -> Floats:
    """Give the equation (4,) that pairs of points (K, 2, n) satisfy best, e(t) free."""
    both = np.concatenate([first, second], axis=1)
    both = both - both.mean(2, keepdims=True)
    return np.linalg.eigh(np.einsum("kip,kjp->ij", both, both, optimize=True))[1][:, 0]
