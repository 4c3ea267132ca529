"""Depths of a surface that bends and hardly stretches, before one camera of known intrinsics, by a convex programme.

Along known sight lines the points are pushed away from the camera as far as the distances between neighbours allow,
which are unknown but the same in every frame ([Chhatkuli2018], after the maximum depth of [Perriollat2011]). The
programme has one minimum, so no start is needed, and perspective tells the sign of depth by itself.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from marey.arrays import Floats, Integers, Mask
from marey.kernels import kernel

FEWEST_TOGETHER = 3
"""Frames in which two points must be seen together to be neighbours."""
APART_IN = 0.95
"""Share of those frames in which neighbours lie within the distance that ranks them: not all, a track may be lost."""
PUSH = 0.03
"""Mean dual of a distance over the stiffness of the splitting: how fast the rounds converge, not what they find."""
DEAREST = 4.0
"""What a stretched distance costs at most, over the mean dual of a distance: a lost point stretches its own."""
ROUNDS = 1500
STILL = 2e-5
"""Change of a depth in one round, as a share of it, at which the rounds end."""


def neighbours(tracks: Floats, seen: Mask, count: int) -> Integers:
    """Find the pairs of points that stay close together in the image.

    Args:
        tracks: (F, 2, P), of any value where not seen.
        seen: (F, P).
        count: of neighbours that each point names.

    Returns:
        (E, 2) pairs, the smaller number first, each once.
    """
    points = tracks.shape[2]
    ranked = np.full((points, points), np.inf)
    for point in range(points):
        together = seen & seen[:, point : point + 1]
        distance = np.linalg.norm(tracks - tracks[:, :, point : point + 1], axis=1)
        enough = together.sum(0) >= FEWEST_TOGETHER
        enough[point] = False
        if enough.any():
            held = np.where(together, distance, np.nan)[:, enough]
            ranked[point, enough] = np.nanquantile(held, APART_IN, axis=0)
    nearest = np.argsort(ranked, axis=1)[:, :count]
    named = np.isfinite(np.take_along_axis(ranked, nearest, 1))
    pairs = np.stack([np.repeat(np.arange(points), nearest.shape[1]), nearest.ravel()], 1)[named.ravel()]
    return np.unique(np.sort(pairs, axis=1), axis=0)


def inextensible_depths(rays: Floats, seen: Mask, pairs: Integers) -> tuple[Floats, Floats]:
    """Find the greatest depths that distances between neighbours allow, the same distances in every frame.

    The mean of the distances is 1. A distance may be exceeded at a price that grows with the excess, not with its
    square, so that single lost tracks bend nothing else. Solved by alternating directions ([Boyd2011]).

    Args:
        rays: (F, 3, P) sight lines with third coordinate 1, of any value where not seen.
        seen: (F, P).
        pairs: (E, 2) neighbours.

    Returns:
        Depths (F, P), NaN where a point is not seen or hangs together with too little of what is; distances (E,).
    """
    first, second = np.ascontiguousarray(pairs[:, 0]), np.ascontiguousarray(pairs[:, 1])
    used = _within_largest_pieces(seen, pairs)
    tied = np.zeros(seen.shape, bool)
    for ends in (first, second):
        np.logical_or.at(tied.T, ends, used.T)
    lengths = np.linalg.norm(rays[:, :, first] - rays[:, :, second], axis=1)
    widest = np.where(used, lengths, 0).max(0)
    widest = np.where(widest > 0, widest, widest[widest > 0].mean())
    depth = np.full(seen.shape, 1 / widest.mean())
    inverse = _inverses(rays, used, first, second)
    push = PUSH * len(pairs) * widest.mean() / tied.sum(1).mean()
    found, distance = _rounds(
        np.ascontiguousarray(np.swapaxes(rays, 1, 2)), used, tied, first, second, inverse, depth,
        widest / widest.mean(), push, DEAREST * PUSH, ROUNDS, STILL,
    )  # fmt: skip
    return np.where(tied, found, np.nan), distance


def _within_largest_pieces(seen: Mask, pairs: Integers) -> Mask:
    """Tell which pairs (F, E) are seen and hang together with most of what they hang together with otherwise.

    A few points that a frame shows apart from the rest would be pushed away alone: seen one behind the other, to
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
    """Number the pieces (P,) in which points hang together by the pairs that are used."""
    ties = coo_array((used[used], (pairs[used, 0], pairs[used, 1])), shape=(count, count))
    return np.asarray(connected_components(ties, directed=False)[1])


def _inverses(rays: Floats, used: Mask, first: Integers, second: Integers) -> Floats:
    """Invert, for each frame, the squared map (P, P) from depths to differences of neighbours."""
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
    rays, used, tied, first, second, inverse, depth, distance, push, dearest, rounds, still
):  # pragma: no cover - compiled
    """Do the alternating steps; rays (F, P, 3), the rest as above."""
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
                rays[f], used[f], tied[f], first, second, inverse[f], depth[f], push, apart[f], apart_dual[f]
            )
            moved = max(moved, change)
            _keep_short(
                rays[f], used[f], first, second, depth[f], distance, dearest, apart[f], apart_dual[f], own[f],
                own_dual[f],
            )  # fmt: skip
        if moved < still:
            break
    return depth, distance


@kernel
def _mean_distances(own, own_dual, used, times, distance):  # pragma: no cover - compiled
    """Each tie's distance: the mean over its frames, the mean of all being 1; into `distance` (E,)."""
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
    rays, used, tied, first, second, inverse, depth, push, apart, apart_dual
):  # pragma: no cover - compiled
    """One frame's depths that agree best with the ties' vectors, pushed away; returns the largest relative change."""
    right = np.zeros(len(rays))
    for p in range(len(rays)):
        if tied[p]:
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
        if tied[p]:
            moved = max(moved, abs(solved[p] - depth[p]) / max(abs(solved[p]), 1e-12))
            depth[p] = solved[p]
    return moved


@kernel
def _keep_short(
    rays, used, first, second, depth, distance, dearest, apart, apart_dual, own, own_dual
):  # pragma: no cover - compiled
    """Shorten one frame's ties that are longer than allowed, each as far as is worth its price."""
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
        less = min(max(0.5 * (length - allowed), 0.0), dearest, length)
        own[e] = allowed + less
        own_dual[e] = -less
        for k in range(3):
            apart[e, k] = wanted[k] * (1.0 - less / max(length, 1e-300))
            apart_dual[e, k] = wanted[k] - apart[e, k]
