"""Depths of a nearly inextensible surface before one camera of known intrinsics, by convex optimisation.

Along known sight lines, points are moved away from the camera as far as the distances between neighbours allow; these
are unknown but the same in every frame ([Chhatkuli2018], after the maximum depth of [Perriollat2011]). The problem has
a single minimum, so no initial solution is needed, and perspective determines the sign of depth.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from marey.arrays import Floats, Integers, Mask
from marey.compiled.kernels import kernel


@dataclass(frozen=True, kw_only=True)
class InextensibleSettings:
    """Settings of depths from constant distances; chosen by hand, results were not measured against other values."""

    fewest_together: int = 3
    """Least number of frames in which two points must be seen together to be neighbours."""
    near_share: float = 0.95
    """Points are ranked by the distance within which they lie in this fraction of those frames; not in all, because
    single tracks may be lost."""
    push: float = 0.03
    """Mean dual variable of a distance over the stiffness of the splitting. It sets how fast the rounds converge, not
    their limit."""
    largest_dual: float = 4.0
    """Upper limit of the dual variable of a distance, over its mean, by which a lost point stretches only its own
    distances."""
    rounds: int = 1500
    """Largest number of rounds; a limit on time."""
    tolerance: float = 2e-5
    """Rounds end when no depth changes by more than this fraction."""


def neighbours(
    tracks: Floats, seen: Mask, count: int, settings: InextensibleSettings = InextensibleSettings()
) -> Integers:
    """Find pairs of points that stay close together in the image.

    Args:
        tracks: (F, 2, P), with arbitrary values where not seen.
        seen: (F, P).
        count: Number of neighbours of each point.
        settings: Which distances are compared.

    Returns:
        (E, 2) pairs of point indices, the smaller first, each pair once.
    """
    points = tracks.shape[2]
    ranked = np.full((points, points), np.inf)
    for point in range(points):
        together = seen & seen[:, point : point + 1]
        distance = np.linalg.norm(tracks - tracks[:, :, point : point + 1], axis=1)
        enough = together.sum(0) >= settings.fewest_together
        enough[point] = False
        if enough.any():
            held = np.where(together, distance, np.nan)[:, enough]
            ranked[point, enough] = np.nanquantile(held, settings.near_share, axis=0)
    nearest = np.argsort(ranked, axis=1)[:, :count]
    named = np.isfinite(np.take_along_axis(ranked, nearest, 1))
    pairs = np.stack([np.repeat(np.arange(points), nearest.shape[1]), nearest.ravel()], 1)[named.ravel()]
    return np.unique(np.sort(pairs, axis=1), axis=0)


def inextensible_depths(
    rays: Floats, seen: Mask, pairs: Integers, settings: InextensibleSettings = InextensibleSettings()
) -> tuple[Floats, Floats]:
    """Compute the greatest depths that distances between neighbours allow, with the same distances in every frame.

    The mean of the distances is 1. Exceeding a distance has a cost that grows linearly with the excess, so that single
    lost tracks do not affect other points. Solved by the alternating direction method of multipliers ([Boyd2011]).

    Args:
        rays: (F, 3, P) sight lines with third coordinate 1, with arbitrary values where not seen.
        seen: (F, P).
        pairs: (E, 2) neighbouring points.
        settings: Tuned constants.

    Returns:
        Depths (F, P), NaN where a point is not seen or connected to too few seen points; distances (E,).
    """
    first, second = np.ascontiguousarray(pairs[:, 0]), np.ascontiguousarray(pairs[:, 1])
    used = _within_largest_pieces(seen, pairs)
    connected = np.zeros(seen.shape, bool)
    for ends in (first, second):
        np.logical_or.at(connected.T, ends, used.T)
    lengths = np.linalg.norm(rays[:, :, first] - rays[:, :, second], axis=1)
    widest = np.where(used, lengths, 0).max(0)
    widest = np.where(widest > 0, widest, widest[widest > 0].mean())
    depth = np.full(seen.shape, 1 / widest.mean())
    inverse = _inverses(rays, used, first, second)
    push = settings.push * len(pairs) * widest.mean() / connected.sum(1).mean()
    found, distance = _rounds(
        np.ascontiguousarray(np.swapaxes(rays, 1, 2)), used, connected, first, second, inverse, depth,
        widest / widest.mean(), push, settings.largest_dual * settings.push, settings.rounds,
        settings.tolerance,
    )  # fmt: skip
    return np.where(connected, found, np.nan), distance


def _within_largest_pieces(seen: Mask, pairs: Integers) -> Mask:
    """Find the pairs (F, E) that are seen and belong to the largest connected piece of their component in a frame.

    A few points that a frame shows apart from the rest would move away alone: if one is seen behind the other, to
    hundreds of times the depth of all others.
    """
    count, (first, second) = seen.shape[1], pairs.T
    used = np.asarray(seen[:, first] & seen[:, second])
    whole = _pieces(np.ones(len(pairs), bool), pairs, count)
    for now in used:
        piece = _pieces(now, pairs, count)
        size = np.bincount(piece, minlength=count)[piece]
        largest = np.zeros(count, int)
        np.maximum.at(largest, whole, size)
        chosen = np.full(count, count)
        np.minimum.at(chosen, whole, np.where(size == largest[whole], piece, count))
        now &= (piece == chosen[whole])[first]
    return used


def _pieces(used: Mask, pairs: Integers, count: int) -> Integers:
    """Number the connected components (P,) of points under the used pairs."""
    graph = coo_array((used[used], (pairs[used, 0], pairs[used, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _inverses(rays: Floats, used: Mask, first: Integers, second: Integers) -> Floats:
    """Invert, for each frame, the normal matrix (P, P) of the map from depths to differences of neighbours."""
    frames, _, points = rays.shape
    square = np.zeros((points, points, frames))
    for one, other in ((first, second), (second, first)):
        own = np.where(used, (rays[:, :, one] ** 2).sum(1), 0)
        across = np.where(used, -(rays[:, :, one] * rays[:, :, other]).sum(1), 0)
        np.add.at(square, (one, one), own.T)
        np.add.at(square, (one, other), across.T)
    square = np.ascontiguousarray(np.moveaxis(square, 2, 0))
    ridge = 1e-9 * np.einsum("fpp->f", square) / points + 1e-12
    return np.linalg.inv(square + ridge[:, None, None] * np.eye(points))


@kernel
def _rounds(
    rays, used, connected, first, second, inverse, depth, distance, push, largest_dual, rounds, still
):  # pragma: no cover - compiled
    """Do the alternating steps; rays are (F, P, 3), the rest as in `inextensible_depths`."""
    frames, edges = len(rays), len(first)
    apart = np.zeros((frames, edges, 3))
    apart_dual, own_dual = np.zeros((frames, edges, 3)), np.zeros((frames, edges))
    own = np.zeros((frames, edges))
    for f in range(frames):
        for e in range(edges):
            own[f, e] = distance[e]
            for k in range(3):
                apart[f, e, k] = rays[f, first[e], k] * depth[f, first[e]] - rays[f, second[e], k] * depth[f, second[e]]
    times = np.zeros(edges)
    for e in range(edges):
        for f in range(frames):
            times[e] += used[f, e]
    for _ in range(rounds):
        _mean_distances(own, own_dual, used, times, distance)
        moved = 0.0
        for f in range(frames):
            change = _solve_depths(
                rays[f], used[f], connected[f], first, second, inverse[f], depth[f], push, apart[f], apart_dual[f]
            )
            moved = max(moved, change)
            _keep_short(
                rays[f], used[f], first, second, depth[f], distance, largest_dual, apart[f], apart_dual[f], own[f],
                own_dual[f],
            )  # fmt: skip
        if moved < still:
            break
    return depth, distance


@kernel
def _mean_distances(own, own_dual, used, times, distance):  # pragma: no cover - compiled
    """Compute the distance of each pair, the mean over its frames, with a mean of 1; into `distance` (E,)."""
    frames, edges = own.shape
    total = 0.0
    for e in range(edges):
        mean = 0.0
        for f in range(frames):
            if used[f, e]:
                mean += own[f, e] - own_dual[f, e]
        distance[e] = mean / max(times[e], 1.0)
        total += distance[e]
    for e in range(edges):
        distance[e] += 1.0 - total / edges


@kernel
def _solve_depths(
    rays, used, connected, first, second, inverse, depth, push, apart, apart_dual
):  # pragma: no cover - compiled
    """Compute the depths of one frame that agree best with the pairs' vectors; return the largest relative change."""
    right = np.zeros(len(rays))
    for p in range(len(rays)):
        if connected[p]:
            right[p] = push
    for e in range(len(first)):
        if used[e]:
            for k in range(3):
                wish = apart[e, k] - apart_dual[e, k]
                right[first[e]] += rays[first[e], k] * wish
                right[second[e]] -= rays[second[e], k] * wish
    solved = inverse @ right
    moved = 0.0
    for p in range(len(rays)):
        if connected[p]:
            moved = max(moved, abs(solved[p] - depth[p]) / max(abs(solved[p]), 1e-12))
            depth[p] = solved[p]
    return moved


@kernel
def _keep_short(
    rays, used, first, second, depth, distance, largest_dual, apart, apart_dual, own, own_dual
):  # pragma: no cover - compiled
    """Shorten the vectors of one frame's pairs that are longer than allowed, as far as the cost demands."""
    wanted = np.zeros(3)
    for e in range(len(first)):
        if not used[e]:
            continue
        length = 0.0
        for k in range(3):
            apart_dual[e, k] += rays[first[e], k] * depth[first[e]] - rays[second[e], k] * depth[second[e]]
            wanted[k] = apart_dual[e, k]
            length += wanted[k] ** 2
        length = np.sqrt(length)
        allowed = distance[e] + own_dual[e]
        less = min(max(0.5 * (length - allowed), 0.0), largest_dual, length)
        own[e] = allowed + less
        own_dual[e] = -less
        for k in range(3):
            apart[e, k] = wanted[k] * (1.0 - less / max(length, 1e-300))
            apart_dual[e, k] = wanted[k] - apart[e, k]
