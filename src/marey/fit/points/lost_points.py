"""Lost points of a surface: where the skin of a fitted body, that has carried them along, expects them."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.surface.tracks.tracking import Expected

_AWAY = 0.03
"""How far from the skin a point may lie to be carried by it [m]."""
_KEPT = 64
"""Frames whose skin is kept ready."""


def expected_by_skin(vertices: Callable[[int], Floats | None], faces: Integers) -> Expected:
    """Let a moving skin say where points are that it has carried since they were measured last.

    A point sticks to the triangle whose middle was nearest, at its own height above it. What [Plaenkers1999] section 5
    wishes for: the model tells where and when a point that vanished will appear again.

    Args:
        vertices: Gives the posed skin (V, 3) of a frame [m]; None where the body is not known.
        faces: (T, 3).

    Returns:
        What `marey.surface.tracks.tracking.track` asks of lost points.
    """

    @lru_cache(_KEPT)
    def skin(frame: int) -> tuple[cKDTree, Floats] | None:
        posed = vertices(frame)
        if posed is None or not np.isfinite(posed).all():
            return None
        corners = np.asarray(posed, float)[faces]
        return cKDTree(corners.mean(axis=1)), corners

    def expected(frame: int, last: Floats, seen: Integers) -> Floats:
        places, now = np.full(last.shape, np.nan), skin(frame)
        for then in np.unique(seen) if now is not None else ():
            before, mine = skin(int(then)), seen == then
            if before is not None and now is not None:
                places[mine] = _carried(last[mine], before, now[1])
        return places

    return expected


def _carried(points: Floats, before: tuple[cKDTree, Floats], corners: Floats) -> Floats:
    """Carry points (n, 3) with their triangles to where these are now."""
    _, face = before[0].query(points)
    own = _axes(before[1][face])
    local = np.linalg.solve(own, (points - before[1][face, 0])[..., None])
    places: Floats = corners[face, 0] + (_axes(corners[face]) @ local)[..., 0]
    # The third axis has length one: its share is the height above the skin [m].
    places[~(np.abs(local[:, 2, 0]) <= _AWAY)] = np.nan
    places[~(np.abs(local[:, :2, 0]).max(axis=1) <= _BESIDE)] = np.nan
    return places


_BESIDE = 3.0
"""How far beside its triangle a point may lie, in the triangle's own edges: beyond, it is on no skin that is known."""


def _axes(corners: Floats) -> Floats:
    """Give two edges and the unit normal of triangles (n, 3, 3) as columns."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(first, second)
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.stack([first, second, normal / length], axis=-1)
