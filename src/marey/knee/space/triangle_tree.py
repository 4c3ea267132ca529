"""Nearest points on a surface and its crossings with rays, by a tree of bounding boxes."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from marey.arrays import Floats, Integers, frozen
from marey.compiled.kernels import kernel
from marey.knee.space.surface import TriangleSurface

MOST_CROSSINGS = 16
"""Largest number of crossings of one ray that are kept: the nearest ones."""
_LEAF = 4
"""Number of triangles in a leaf, approximately; chosen by hand."""
_DEEPEST = 64
"""Length of the stack of boxes in a search; more than the depth of any tree that fits into memory."""
SCRATCH = (2, 2 * _DEEPEST)
"""Shape of the working array of a search: a stack of boxes with their squared distances, and a trial point."""
_SAME_MM = 1e-6
"""Crossings of one ray nearer to each other than this [mm] are one: a ray may meet two triangles at their edge."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NearestPoints:
    """The nearest point on the surface for each query point."""

    points_mm: Floats
    """(..., 3); NaN where nothing lies within reach."""
    distance_mm: Floats
    """(...), never negative; infinite where nothing lies within reach."""
    face: Integers
    """(...), -1 where nothing lies within reach."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Crossings:
    """Crossings of rays with a surface, in order along each ray."""

    distance_mm: Floats
    """(R, `MOST_CROSSINGS`) from the ray's start; NaN after the last."""
    leaving: Integers
    """(R, `MOST_CROSSINGS`) 1 where the ray leaves the surface, -1 where it enters, 0 after the last."""


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """Binary tree of bounding boxes of a surface's triangles: box i contains the boxes 2 i + 1 and 2 i + 2."""

    corners_mm: Floats
    """(T, 3, 3) in the order of the leaves."""
    faces: Integers
    """(T,) index of each triangle among the faces of the surface."""
    low_mm: Floats
    """(B, 3) least corner of each box."""
    high_mm: Floats
    """(B, 3)."""
    starts: Integers
    """(leaves + 1,) index of the first triangle of each leaf."""

    @staticmethod
    def of(surface: TriangleSurface) -> "TriangleTree":
        """Return the tree of a surface, built once per surface by halving boxes along their longest side."""
        if surface not in _SORTED:
            _SORTED[surface] = TriangleTree._of(surface)
        return _SORTED[surface]

    @staticmethod
    def _of(surface: TriangleSurface) -> "TriangleTree":
        corners = surface.corners_mm
        middle = corners.mean(1)
        order, starts = np.arange(len(corners)), np.array([0, len(corners)])
        for _ in range(max(int(np.log2(max(len(corners) / _LEAF, 1))), 0)):
            box = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
            size = np.maximum.reduceat(middle[order], starts[:-1]) - np.minimum.reduceat(middle[order], starts[:-1])
            order = order[np.lexsort((middle[order, np.argmax(size, axis=1)[box]], box))]
            halves = np.empty(2 * len(starts) - 1, np.int64)
            halves[::2], halves[1::2] = starts, (starts[:-1] + starts[1:]) // 2
            starts = halves
        low = [np.minimum.reduceat(corners[order].min(1), starts[:-1])]
        high = [np.maximum.reduceat(corners[order].max(1), starts[:-1])]
        while len(low[0]) > 1:
            low.insert(0, np.minimum(low[0][::2], low[0][1::2]))
            high.insert(0, np.maximum(high[0][::2], high[0][1::2]))
        return TriangleTree(frozen(corners[order]), order, np.concatenate(low), np.concatenate(high), starts)

    def nearest(self, points_mm: Floats, reach_mm: float = np.inf) -> NearestPoints:
        """Find the points of the surface nearest to given ones.

        Args:
            points_mm: (..., 3).
            reach_mm: Points farther than this are not searched, which saves most of the time where most are far.
        """
        queries = _readable(points_mm).reshape(-1, 3)
        found, face = np.full(queries.shape, np.nan), np.empty(len(queries), np.int64)
        _nearest(queries, self.corners_mm, self.low_mm, self.high_mm, self.starts, float(reach_mm), found, face)
        shape = np.shape(points_mm)
        away = np.where(face >= 0, np.linalg.norm(found - queries, axis=1), np.inf)
        return NearestPoints(
            points_mm=found.reshape(shape),
            distance_mm=away.reshape(shape[:-1]),
            face=np.where(face >= 0, self.faces[face], -1).reshape(shape[:-1]),
        )

    def crossings(self, starts_mm: Floats, directions: Floats, reach_mm: float) -> Crossings:
        """Find where rays cross the surface.

        Args:
            starts_mm: (R, 3).
            directions: (R, 3) of any length; a ray of length zero crosses nothing.
            reach_mm: Length of each ray.
        """
        begin = _readable(starts_mm)
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        along = np.divide(directions, length, out=np.zeros_like(begin), where=length > 0)
        distance = np.full((len(begin), MOST_CROSSINGS), np.nan)
        leaving = np.zeros((len(begin), MOST_CROSSINGS), np.int64)
        _crossings(
            begin, along, float(reach_mm), self.corners_mm, self.low_mm, self.high_mm, self.starts, distance, leaving
        )
        return Crossings(distance_mm=distance, leaving=leaving)


_SORTED: WeakKeyDictionary[TriangleSurface, TriangleTree] = WeakKeyDictionary()
"""The tree of each surface for which it was built."""


def _readable(points: Floats) -> Floats:
    """Return a contiguous read-only view: Numba would compile another specialisation for writable arrays."""
    view = np.ascontiguousarray(points, float).view()
    view.setflags(write=False)
    return view


@kernel
def _share(part, whole):  # pragma: no cover - compiled
    """Divide; 0 / 0 is 0, for triangles without area."""
    return part / whole if whole != 0.0 else 0.0


@kernel
def _nearest_on_triangle(point, corners, out):  # pragma: no cover - compiled
    """Write the point of a triangle (3, 3) nearest to another and give its squared distance ([Ericson2005] 5.1.5)."""
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = corners[1, i] - corners[0, i], corners[2, i] - corners[0, i]
        ap, bp, cp = point[i] - corners[0, i], point[i] - corners[1, i], point[i] - corners[2, i]
        d1 += ab * ap
        d2 += ac * ap
        d3 += ab * bp
        d4 += ac * bp
        d5 += ab * cp
        d6 += ac * cp
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    # Barycentric weights of the second and the third corner.
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = _share(d1, d1 - d3), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, _share(d2, d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = _share(d4 - d3, (d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = _share(vb, va + vb + vc), _share(vc, va + vb + vc)
    squared = 0.0
    for i in range(3):
        out[i] = (1.0 - v - w) * corners[0, i] + v * corners[1, i] + w * corners[2, i]
        squared += (point[i] - out[i]) ** 2
    return squared


def corner_weights(corners_mm: Floats, places_mm: Floats) -> Floats:
    """Return the weights (..., 3) of triangles' corners (..., 3, 3) at places (..., 3) in them."""
    first, second = corners_mm[..., 1, :] - corners_mm[..., 0, :], corners_mm[..., 2, :] - corners_mm[..., 0, :]
    off = places_mm - corners_mm[..., 0, :]
    a, b, c = (np.einsum("...i,...i->...", p, q) for p, q in ((first, first), (first, second), (second, second)))
    x, y = np.einsum("...i,...i->...", off, first), np.einsum("...i,...i->...", off, second)
    whole = np.maximum(a * c - b * b, 1e-12)
    v, w = (c * x - b * y) / whole, (a * y - b * x) / whole
    return np.asarray(np.clip(np.stack([1 - v - w, v, w], -1), 0, 1))


@kernel
def _to_box(point, low, high):  # pragma: no cover - compiled
    """Return the squared distance of a point from a box."""
    squared = 0.0
    for i in range(3):
        squared += max(low[i] - point[i], 0.0, point[i] - high[i]) ** 2
    return squared


@kernel
def _keep(trial, found):  # pragma: no cover - compiled
    """Copy a point by elements: for a slice Numba would also compile error handling, which takes seconds."""
    for i in range(3):
        found[i] = trial[i]


@kernel
def nearest_triangle(point, corners, low, high, starts, guess, reach, found, scratch):  # pragma: no cover - compiled
    """Write the nearest point (3,) of a tree's triangles and give the triangle's number; -1 where none is in reach.

    The nearer box is searched first, and boxes farther than the point found so far are skipped. A good guess of the
    triangle's number saves most of the search; -1 means none. `scratch` has the shape `SCRATCH`.
    """
    leaves = len(starts) - 1
    waiting, trial = scratch[0], scratch[1]
    best, face, count = reach * reach, -1, 1
    if guess >= 0:
        best, face = _nearest_on_triangle(point, corners[guess], trial), guess
        _keep(trial, found)
    waiting[0], waiting[1] = 0.0, 0.0
    while count > 0:
        count -= 1
        box = int(waiting[2 * count])
        if waiting[2 * count + 1] >= best:
            continue
        if box >= leaves - 1:
            for t in range(starts[box - leaves + 1], starts[box - leaves + 2]):
                squared = _nearest_on_triangle(point, corners[t], trial)
                if squared < best:
                    best, face = squared, t
                    _keep(trial, found)
            continue
        one, two = 2 * box + 1, 2 * box + 2
        to_one, to_two = _to_box(point, low[one], high[one]), _to_box(point, low[two], high[two])
        if to_one < to_two:
            one, two, to_one, to_two = two, one, to_two, to_one
        waiting[2 * count], waiting[2 * count + 1] = one, to_one
        waiting[2 * count + 2], waiting[2 * count + 3] = two, to_two
        count += 2
    return face


@kernel
def _nearest(points, corners, low, high, starts, reach, found, face):  # pragma: no cover - compiled
    """Find the nearest point of each, one after the other."""
    scratch = np.empty(SCRATCH)
    for n in range(len(points)):
        face[n] = nearest_triangle(points[n], corners, low, high, starts, -1, reach, found[n], scratch)


@kernel
def _meet(start, along, corners):  # pragma: no cover - compiled
    """Return the distance along a ray to a triangle, and 1 or -1 by its side; 0 where it misses ([Moeller1997])."""
    slope = squared = height = u = v = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        abj, abk = corners[1, j] - corners[0, j], corners[1, k] - corners[0, k]
        acj, ack = corners[2, j] - corners[0, j], corners[2, k] - corners[0, k]
        normal = abj * ack - abk * acj
        slope += normal * along[i]
        squared += normal * normal
        height -= normal * (start[i] - corners[0, i])
        turned = along[j] * (start[k] - corners[0, k]) - along[k] * (start[j] - corners[0, j])
        u += (corners[2, i] - corners[0, i]) * turned
        v -= (corners[1, i] - corners[0, i]) * turned
    if abs(slope) <= 1e-12 * np.sqrt(squared):
        return 0.0, 0
    # With a margin for rounding: a ray through a common edge meets one or both triangles; duplicates are joined.
    if u / slope < -1e-9 or v / slope < -1e-9 or (u + v) / slope > 1.0 + 1e-9:
        return 0.0, 0
    return height / slope, 1 if slope > 0 else -1


@kernel
def _passes(start, along, reach, low, high):  # pragma: no cover - compiled
    """Return whether a ray crosses a box."""
    entry, last = 0.0, reach
    for i in range(3):
        if along[i] == 0.0:
            if start[i] < low[i] or start[i] > high[i]:
                return False
        else:
            one, two = (low[i] - start[i]) / along[i], (high[i] - start[i]) / along[i]
            entry, last = max(entry, min(one, two)), min(last, max(one, two))
    return entry <= last + _SAME_MM


@kernel
def _crossings(begin, along, reach, corners, low, high, starts, distance, leaving):  # pragma: no cover - compiled
    """Test the triangles of each box that a ray crosses."""
    leaves = len(starts) - 1
    waiting = np.empty(_DEEPEST, np.int64)
    for n in range(len(begin)):
        found, count = 0, 1
        waiting[0] = 0
        if along[n, 0] == 0.0 and along[n, 1] == 0.0 and along[n, 2] == 0.0:
            continue
        while count > 0:
            count -= 1
            box = waiting[count]
            if not _passes(begin[n], along[n], reach, low[box], high[box]):
                continue
            if box < leaves - 1:
                waiting[count], waiting[count + 1] = 2 * box + 1, 2 * box + 2
                count += 2
                continue
            for t in range(starts[box - leaves + 1], starts[box - leaves + 2]):
                away, sign = _meet(begin[n], along[n], corners[t])
                if sign != 0 and 0.0 <= away <= reach:
                    found = _record(distance[n], leaving[n], found, away, sign)


@kernel
def _record(distance, leaving, found, away, sign):  # pragma: no cover - compiled
    """Insert a crossing in order, unless it is already there."""
    place = found
    while place > 0 and distance[place - 1] > away:
        place -= 1
    for near in (place - 1, place):
        if 0 <= near < found and abs(distance[near] - away) < _SAME_MM and leaving[near] == sign:
            return found
    if place >= len(distance):
        return found
    last = min(found, len(distance) - 1)
    for i in range(last, place, -1):
        distance[i], leaving[i] = distance[i - 1], leaving[i - 1]
    distance[place], leaving[place] = away, sign
    return min(found + 1, len(distance))
