"""Predicted positions of lost surface points, from the skin of a fitted body that carries them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.geometry.vectors import unit_or_zero
from marey.surface.tracks.tracking import Expected

_CACHED_FRAMES = 64
"""Number of frames whose skin is cached."""


@dataclass(frozen=True, kw_only=True)
class LostPointSettings:
    """Settings of the prediction of lost points.

    The defaults were chosen by hand; results were not measured against other values.
    """

    most_above_m: float = 0.03
    """Greatest distance from the skin of a point that is carried by it [m]."""
    most_beside: float = 3.0
    """Greatest distance of a point beside its triangle, in units of the triangle's edges; a point farther away is not
    predicted."""


LOST_POINT_DEFAULTS = LostPointSettings()
"""Default settings of the prediction of lost points."""


def expected_by_skin(
    vertices: Callable[[int], Floats | None], faces: Integers, settings: LostPointSettings = LOST_POINT_DEFAULTS
) -> Expected:
    """Return a function that predicts points from the moving skin that carries them since they were last measured.

    A point is attached to the triangle whose centre is nearest, at its own height above it. [Plaenkers1999] section 5
    proposes it: the model predicts where and when a point that vanished will appear again.

    Args:
        vertices: Returns the posed skin (V, 3) of a frame [m]; None if the body is unknown.
        faces: (T, 3).
        settings: Largest distances of a point from its triangle.

    Returns:
        The predictor of lost points for `marey.surface.tracks.tracking.track`.
    """

    @lru_cache(_CACHED_FRAMES)
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
                places[mine] = _move_with_triangles(last[mine], before, now[1], settings)
        return places

    return expected


def _move_with_triangles(
    points: Floats, before: tuple[cKDTree, Floats], corners: Floats, settings: LostPointSettings
) -> Floats:
    """Move points (n, 3) with their triangles to the triangles' current positions."""
    _, face = before[0].query(points)
    own = _axes(before[1][face])
    local = np.linalg.solve(own, (points - before[1][face, 0])[..., None])
    places: Floats = corners[face, 0] + (_axes(corners[face]) @ local)[..., 0]
    # The third axis has length one: its coordinate is the height above the skin [m].
    places[~(np.abs(local[:, 2, 0]) <= settings.most_above_m)] = np.nan
    places[~(np.abs(local[:, :2, 0]).max(axis=1) <= settings.most_beside)] = np.nan
    return places


def _axes(corners: Floats) -> Floats:
    """Return two edges and the unit normal of triangles (n, 3, 3) as columns."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.stack([first, second, unit_or_zero(np.cross(first, second))], axis=-1)
