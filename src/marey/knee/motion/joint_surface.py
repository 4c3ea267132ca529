"""The articular side of a cartilage, and signed distances of points from it."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, Mask, frozen
from marey.compiled.kernels import kernel
from marey.errors import MareyError
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import SCRATCH, TriangleTree, nearest_triangle

FACING = 0.3
"""A face of a cartilage belongs to the joint's side when the cosine between its normal and the bone's is above this:
the side on the bone has -1, the walls at the rim have about 0."""
COMPARTMENTS = ("medial", "lateral")
"""Names of the compartments of a knee."""
_TRIMMED = 0.01
"""Share of the vertices that is ignored at each end when a bone's width is measured; chosen by hand."""
_ON = 1e-7
"""Barycentric weight of a corner below which a point lies on the opposite side of the triangle: rounding errors."""


class Heights(NamedTuple):
    """Signed distances of points from an articular surface."""

    distance_mm: Floats
    """(N,) distance from the surface, negative below it; NaN for a point below it whose nearest point is on the rim."""
    places_mm: Floats
    """(N, 3) the nearest points of the surface."""
    upward: Floats
    """(N, 3) unit vectors, along which the distance increases."""
    triangle: Integers
    """(N,) triangles of the tree, a good guess after a small motion."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StructureVertices:
    """The vertices of a structure that belong to its articular side."""

    name: str
    """The structure."""
    sources: Integers
    """(V,) index of each vertex in the whole structure."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointSurface(StructureVertices):
    """An open surface of triangles that face outward, into the joint."""

    surface: TriangleSurface
    lateral: Mask | None
    """(V,) true on the lateral side of the bone's middle; None where the knee's side is not known."""

    @cached_property
    def tree(self) -> TriangleTree:
        """Tree of its triangles."""
        return TriangleTree.of(self.surface)

    @cached_property
    def _normals(self) -> tuple[Floats, Mask]:
        """(T, 7, 3) normals of each of the tree's faces, its sides and its corners, and (T, 7) where they are rim.

        Normals of sides are sums over both faces, and those of corners over all adjacent faces, weighted by their
        angles, so that the sign of the distance is correct where these are nearest as well ([Baerentzen2005]).
        """
        faces, across = self.surface.faces, self.surface.face_normals
        normals, rim = np.zeros((len(faces), 7, 3)), np.zeros((len(faces), 7), bool)
        normals[:, 0] = across
        sides = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
        _, side, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
        both = np.zeros((len(count), 3))
        np.add.at(both, side.reshape(-1), np.repeat(across, 3, axis=0))
        normals[:, 1:4] = both[side].reshape(-1, 3, 3)
        open_side = (count == 1)[side.reshape(-1)]
        rim[:, 1:4] = open_side.reshape(-1, 3)
        about = np.zeros_like(self.surface.vertices_mm)
        np.add.at(about, faces.ravel(), (self._angles[..., None] * across[:, None]).reshape(-1, 3))
        on_rim = np.zeros(len(about), bool)
        on_rim[sides[open_side].ravel()] = True
        normals[:, 4:], rim[:, 4:] = about[faces], on_rim[faces]
        length = np.linalg.norm(normals, axis=2, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        order = self.tree.faces
        return np.ascontiguousarray(normals[order]), np.ascontiguousarray(rim[order])

    @property
    def _angles(self) -> Floats:
        """(T, 3) angles of the faces' corners [rad]."""
        corners = self.surface.corners_mm
        ahead, back = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
        across = np.linalg.norm(np.cross(ahead, back), axis=2)
        return np.asarray(np.arctan2(across, (ahead * back).sum(2)))

    def heights(self, points_mm: Floats, guess: Integers | None = None) -> Heights:
        """Return the signed distances of points from the surface.

        Args:
            points_mm: (N, 3).
            guess: (N,) triangles of the tree, such as those of the previous frame.
        """
        points = np.ascontiguousarray(points_mm, float)
        if guess is None:
            guess = np.full(len(points), -1, np.int64)
        distance, places = np.empty(len(points)), np.empty_like(points)
        upward, triangle = np.empty_like(points), np.empty(len(points), np.int64)
        tree, (normals, rim) = self.tree, self._normals
        _heights(
            points, tree.corners_mm, tree.low_mm, tree.high_mm, tree.starts, normals, rim, guess, distance, places,
            upward, triangle,
        )  # fmt: skip
        return Heights(distance, places, upward, triangle)

    def of_lateral(self, triangle: Integers) -> Mask:
        """Return whether triangles of the tree (N,) are lateral, by their first corner."""
        if self.lateral is None:
            raise MareyError("The knee's side is not known.")
        return np.asarray(self.lateral[self.surface.faces[self.tree.faces[triangle], 0]])

    def onto(self, places_mm: Floats) -> Floats:
        """Project positions (..., 3) to the nearest points of the surface; NaN is kept."""
        known = np.isfinite(places_mm).all(-1)
        moved = np.full(np.shape(places_mm), np.nan)
        moved[known] = self.tree.nearest(np.asarray(places_mm)[known]).points_mm
        return moved


def joint_surface(name: str, cartilage: TriangleSurface, bone: TriangleSurface, *, left: bool | None) -> JointSurface:
    """Return the side of a cartilage that faces away from its bone.

    Args:
        name: Name of the structure.
        cartilage: Closed.
        bone: On which it lies.
        left: Whether it is of a left knee: LPS x increases to the left; None where it is not known.

    Raises:
        MareyError: No face faces away from the bone.
    """
    middles = cartilage.corners_mm.mean(1)
    under = bone.face_normals[TriangleTree.of(bone).nearest(middles).face]
    faces = cartilage.faces[(cartilage.face_normals * under).sum(1) > FACING]
    if not len(faces):
        raise MareyError(f"The {name.replace('_', ' ')} has no side that faces away from its bone.")
    return _part(name, cartilage, faces, left, bone)


def whole_surface(name: str, bone: TriangleSurface, *, left: bool | None) -> JointSurface:
    """Return the whole surface of a bone without cartilage."""
    return _part(name, bone, bone.faces, left, bone)


def _part(name: str, whole: TriangleSurface, faces: Integers, left: bool | None, bone: TriangleSurface) -> JointSurface:
    sources, numbers = np.unique(faces, return_inverse=True)
    places = whole.vertices_mm[sources]
    lateral = None
    if left is not None:
        # The bone's middle, not the cartilage's: one side of it may be bare.
        low, high = np.quantile(bone.vertices_mm[:, 0], (_TRIMMED, 1 - _TRIMMED))
        lateral = (places[:, 0] > 0.5 * (low + high)) == left
    surface = TriangleSurface(vertices_mm=places, faces=numbers.reshape(-1, 3))
    return JointSurface(name=name, surface=surface, sources=frozen(sources, np.int64), lateral=lateral)


@kernel
def _feature(corners, place):  # pragma: no cover - compiled
    """Return 0 for a point within a triangle, 1 to 3 for the side opposite a corner, 4 to 6 for a corner."""
    aa = ab = bb = xa = xb = 0.0
    for i in range(3):
        one, two, off = corners[1, i] - corners[0, i], corners[2, i] - corners[0, i], place[i] - corners[0, i]
        aa += one * one
        ab += one * two
        bb += two * two
        xa += off * one
        xb += off * two
    whole = max(aa * bb - ab * ab, 1e-12)
    v, w = (bb * xa - ab * xb) / whole, (aa * xb - ab * xa) / whole
    u = 1.0 - v - w
    if u > _ON and v > _ON and w > _ON:
        return 0
    if v > _ON and w > _ON:
        return 1
    if u > _ON and w > _ON:
        return 2
    if u > _ON and v > _ON:
        return 3
    return 4 if u > _ON else (5 if v > _ON else 6)


@kernel
def _heights(
    points, corners, low, high, starts, normals, rim, guess, distance, places, upward, triangle
):  # pragma: no cover - compiled
    """Find the nearest point of the surface for each point, and the side it lies on."""
    scratch = np.empty(SCRATCH)
    for n in range(len(points)):
        t = nearest_triangle(points[n], corners, low, high, starts, guess[n], np.inf, places[n], scratch)
        part = _feature(corners[t], places[n])
        squared = above = 0.0
        for i in range(3):
            off = points[n, i] - places[n, i]
            squared += off * off
            above += off * normals[t, part, i]
        away = np.sqrt(squared)
        sign = 1.0 if above >= 0.0 else -1.0
        triangle[n] = t
        distance[n] = sign * away if sign > 0.0 or not rim[t, part] else np.nan
        for i in range(3):
            # On the surface itself the difference has no direction: there it is the normal's.
            along = sign * (points[n, i] - places[n, i]) / away if away > 1e-9 else normals[t, part, i]
            upward[n, i] = along
