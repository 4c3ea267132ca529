"""Local motion of a surface about a position, from the points tracked near it."""

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers, Mask

NEIGHBOURS = 8
"""Number of neighbours from which the motion of the surface is estimated; at least half as many are required. Chosen by
hand."""
_CHOICE = 3 * NEIGHBOURS
"""Number of candidate neighbours, of which the nearest measured ones are used. Chosen by hand."""
_REACH = 6.0
"""Largest distance of a neighbour, as a multiple of the median distance to the nearest point. Chosen by hand."""


def radius_of(position: Floats) -> float:
    """Say how near points must be to be neighbours: six times the usual distance to the nearest one.

    Args:
        position: (N, 3) [m]; NaN where not known.

    Returns:
        The distance [m]; zero with fewer than two points.
    """
    known = position[np.isfinite(position).all(axis=1)]
    if len(known) < 2:
        return 0.0
    return _REACH * float(np.median(cKDTree(known).query(known, k=2)[0][:, 1]))


def neighbours_of(places: Floats, known: Floats, *, count: int = NEIGHBOURS, radius: float) -> Integers:
    """Find the nearest known points of each place.

    Args:
        places: (n, 3) [m]; NaN has no neighbours.
        known: (m, 3) [m].
        count: At most so many.
        radius: How far away they may be [m].

    Returns:
        (n, count) indices, m where there is no further one so near.
    """
    found = np.full((len(places), count), len(known))
    asked = np.isfinite(places).all(axis=1)
    if len(known) and asked.any():
        near = cKDTree(known).query(places[asked], k=count, distance_upper_bound=radius)[1]
        found[asked] = np.asarray(near, np.int64).reshape(-1, count)
    return found


def carried(places: Floats, before: Floats, after: Floats, *, radius: float, count: int = NEIGHBOURS) -> Floats:
    """Carry places along with the surface about them.

    Each place moves rigidly with its neighbours, see `moved_rigidly`.

    Args:
        places: (n, 3) where they were [m].
        before: (m, 3) followed points [m].
        after: (m, 3) where these are now [m].
        radius: How far away a neighbour may be [m].
        count: Neighbours that are asked, at most.

    Returns:
        Where the places are now (n, 3), NaN with less than four neighbours.
    """
    near = neighbours_of(places, before, radius=radius, count=count)
    used = near < len(before)
    if not used.any():
        return np.full((len(places), 3), np.nan)
    rows = np.where(used, near, 0)
    return moved_rigidly(places, before[rows], after[rows], used)[0]


def candidates(position: Floats, which: Integers, *, radius: float) -> Integers:
    """Find more neighbours (n, k) than are needed of some points among all; N for none.

    Args:
        position: (N, 3) [m]; NaN where not measured.
        which: (n,) the points.
        radius: How far away they may be [m].
    """
    known = np.flatnonzero(np.isfinite(position[:, 0]))
    found = neighbours_of(position[which], position[known], count=_CHOICE + 1, radius=radius)
    near = np.append(known, len(position))[found]
    near[near == which[:, None]] = len(position)
    return near


def misfit(start: Floats, end: Floats, which: Integers, near: Integers) -> tuple[Floats, Floats]:
    """Measure how far points are from where the surface about them has gone.

    Args:
        start: (N, 3) all points before [m]; NaN where not measured.
        end: (N, 3) and after [m].
        which: (n,) the points.
        near: (n, k) their `candidates`; the nearest that are measured before and after count.

    Returns:
        Distances (n,) and what the neighbours' own motion leaves of them in each direction (n,) [m]; NaN with less
        than four neighbours.
    """
    usable = np.append(np.isfinite(start[:, 0]) & np.isfinite(end[:, 0]), False)[near]
    order = np.argsort(~usable, axis=1, kind="stable")[:, :NEIGHBOURS]
    used = np.take_along_axis(usable, order, axis=1)
    rows = np.where(used, np.take_along_axis(near, order, axis=1), 0)
    moved, spread = moved_rigidly(start[which], start[rows], end[rows], used)
    return np.linalg.norm(end[which] - moved, axis=1), spread


def moved_rigidly(places: Floats, start: Floats, end: Floats, used: Mask) -> tuple[Floats, Floats]:
    """Move each place by the rigid motion that carries its neighbours best.

    The neighbour whose step differs most from the median of all is left out.

    Args:
        places: (n, 3) [m].
        start: (n, k, 3) neighbours before [m].
        end: (n, k, 3) and after [m].
        used: (n, k) which of them count.

    Returns:
        The places afterwards (n, 3) [m], and the standard deviation in each direction (n,) of what the motion leaves of
        the neighbours [m]; NaN with less than four of them.
    """
    step = np.where(used[..., None], end - start, np.nan)
    used = used.copy()
    enough = np.count_nonzero(used, axis=1) * 2 >= NEIGHBOURS
    moved, spread = np.full((len(places), 3), np.nan), np.full(len(places), np.nan)
    used, step = used[enough], step[enough]
    start, end = (np.where(used[..., None], side[enough], 0.0) for side in (start, end))
    if not len(used):
        return moved, spread
    apart = np.linalg.norm(step - np.nanmedian(step, axis=1, keepdims=True), axis=-1)
    used[np.arange(len(used)), np.nan_to_num(apart, nan=-1.0).argmax(axis=1)] = False
    share = used / used.sum(axis=1, keepdims=True)
    middle, arrived = (np.einsum("nk,nki->ni", share, side) for side in (start, end))
    out, back = end - arrived[:, None], start - middle[:, None]
    left, _, right = np.linalg.svd(np.einsum("nk,nki,nkj->nij", share, out, back))
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    turn = left @ right
    moved[enough] = arrived + np.einsum("nij,nj->ni", turn, places[enough] - middle)
    rest = out - np.einsum("nij,nkj->nki", turn, back)
    freedom = np.maximum(3 * used.sum(axis=1) - 6, 1)
    spread[enough] = np.sqrt(np.sum(used[..., None] * rest**2, axis=(1, 2)) / freedom)
    return moved, spread
