"""Local motion of a surface about a position, from the points tracked near it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers, Mask
from marey.surface.tracks.local_motion_kernels import move_rigidly


@dataclass(frozen=True, kw_only=True)
class LocalMotionSettings:
    """Settings of the motion of a surface about a position.

    The defaults were chosen by hand; results were not measured against other values.
    """

    neighbours: int = 8
    """Number of neighbours from which the motion of the surface is estimated; at least half as many are required."""
    candidates_ratio: int = 3
    """Number of candidate neighbours, of which the nearest measured ones are used, as a multiple of that number."""
    reach_ratio: float = 6.0
    """Largest distance of a neighbour, as a multiple of the median distance to the nearest point."""


LOCAL_MOTION_DEFAULTS = LocalMotionSettings()
"""Default settings of the motion of a surface about a position."""


def radius_of(position: Floats, settings: LocalMotionSettings = LOCAL_MOTION_DEFAULTS) -> float:
    """Compute the largest distance of neighbours: by default six times the median distance to the nearest point.

    Args:
        position: (N, 3) positions [m]; NaN where unknown.
        settings: Ratio of the two distances.

    Returns:
        The distance [m]; zero with fewer than two points.
    """
    known = position[np.isfinite(position).all(axis=1)]
    if len(known) < 2:
        return 0.0
    return settings.reach_ratio * float(np.median(cKDTree(known).query(known, k=2)[0][:, 1]))


def neighbours_of(
    places: Floats, known: Floats, *, count: int = LOCAL_MOTION_DEFAULTS.neighbours, radius: float
) -> Integers:
    """Find the nearest known points of each position.

    Args:
        places: (n, 3) positions [m]; NaN has no neighbours.
        known: (m, 3) known points [m].
        count: Largest number of neighbours.
        radius: Largest distance of a neighbour [m].

    Returns:
        (n, count) indices, m where there is no further neighbour.
    """
    found = np.full((len(places), count), len(known))
    finite = np.isfinite(places).all(axis=1)
    if len(known) and finite.any():
        near = cKDTree(known).query(places[finite], k=count, distance_upper_bound=radius)[1]
        found[finite] = np.asarray(near, np.int64).reshape(-1, count)
    return found


def carried(
    places: Floats, before: Floats, after: Floats, *, radius: float, count: int | None = None,
    settings: LocalMotionSettings = LOCAL_MOTION_DEFAULTS,
) -> Floats:  # fmt: skip
    """Move positions with the surrounding surface.

    Each position moves rigidly with its neighbours, see `moved_rigidly`.

    Args:
        places: (n, 3) positions before [m].
        before: (m, 3) tracked points before [m].
        after: (m, 3) tracked points afterwards [m].
        radius: Largest distance of a neighbour [m].
        count: Largest number of neighbours; by default that of the settings.
        settings: Number of neighbours.

    Returns:
        Positions afterwards (n, 3) [m]; NaN with fewer than half of the settings' neighbours.
    """
    count = settings.neighbours if count is None else count
    near = neighbours_of(places, before, radius=radius, count=count)
    used = near < len(before)
    if not used.any():
        return np.full((len(places), 3), np.nan)
    rows = np.where(used, near, 0)
    return moved_rigidly(places, before[rows], after[rows], used, settings)[0]


def candidates(
    position: Floats, which: Integers, *, radius: float, settings: LocalMotionSettings = LOCAL_MOTION_DEFAULTS
) -> Integers:
    """Find more neighbours than needed of some points among all.

    Args:
        position: (N, 3) positions [m]; NaN where not measured.
        which: (n,) indices of the points.
        radius: Largest distance of a neighbour [m].
        settings: Number of candidates.

    Returns:
        (n, k) indices of the neighbours, N for none.
    """
    known = np.flatnonzero(np.isfinite(position[:, 0]))
    count = settings.candidates_ratio * settings.neighbours + 1
    found = neighbours_of(position[which], position[known], count=count, radius=radius)
    near = np.append(known, len(position))[found]
    near[near == which[:, None]] = len(position)
    return near


def misfit(
    start: Floats, end: Floats, which: Integers, near: Integers, settings: LocalMotionSettings = LOCAL_MOTION_DEFAULTS
) -> tuple[Floats, Floats]:
    """Compute the deviation of points from the motion of the surrounding surface.

    Args:
        start: (N, 3) all points before [m]; NaN where not measured.
        end: (N, 3) all points afterwards [m].
        which: (n,) indices of the points.
        near: (n, k) their `candidates`, of which the nearest measured before and afterwards are used.
        settings: Number of neighbours.

    Returns:
        Deviations (n,) [m], and the standard deviation of the neighbours from their rigid motion in each direction
        (n,) [m]; NaN with fewer than half of the settings' neighbours.
    """
    usable = np.append(np.isfinite(start[:, 0]) & np.isfinite(end[:, 0]), False)[near]
    order = np.argsort(~usable, axis=1, kind="stable")[:, : settings.neighbours]
    used = np.take_along_axis(usable, order, axis=1)
    rows = np.where(used, np.take_along_axis(near, order, axis=1), 0)
    moved, spread = moved_rigidly(start[which], start[rows], end[rows], used, settings)
    return np.linalg.norm(end[which] - moved, axis=1), spread


def moved_rigidly(
    places: Floats, start: Floats, end: Floats, used: Mask, settings: LocalMotionSettings = LOCAL_MOTION_DEFAULTS
) -> tuple[Floats, Floats]:
    """Move each position by the best-fitting rigid motion of its neighbours.

    The neighbour whose step differs most from the median of all is excluded.

    Args:
        places: (n, 3) positions before [m].
        start: (n, k, 3) neighbours before [m].
        end: (n, k, 3) neighbours afterwards [m].
        used: (n, k) which of the neighbours are used.
        settings: Number of neighbours, of which half are required.

    Returns:
        Positions afterwards (n, 3) [m], and the standard deviation of the neighbours from the motion in each direction
        (n,) [m]; NaN with fewer than half of the settings' neighbours.
    """
    moved, spread = np.empty((len(places), 3)), np.empty(len(places))
    start, end = (np.ascontiguousarray(side, float) for side in (start, end))
    move_rigidly(np.ascontiguousarray(places, float), start, end, used, settings.neighbours, moved, spread)
    return moved, spread
