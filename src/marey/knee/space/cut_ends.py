"""Detection of the flat ends at which a bone was cut off by its image, and of open rims."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from marey.arrays import Floats, Mask, freeze_fields
from marey.knee.space.surface import TriangleSurface

LEAST_CUT_MM2 = 200.0
"""Least area [mm2] of a flat end; chosen by hand."""
FLAT_MM = 0.6
"""Largest distance [mm] of a flat end from its plane: labels often end in a step of half a voxel."""
ALIGNED = 0.99
"""Cosine of the largest angle of its faces to the plane, 8 degrees; chosen by hand."""
EVEN = np.radians(4.4)
"""Largest root mean square [rad] of that angle: it is 5.7 degrees in a cap of a ball, and 1 to 4.4 in cut shafts."""
LEANING = 0.94
"""Cosine of the largest angle, 20 degrees, before the plane's own orientation is known; chosen by hand."""
_CANDIDATES = 300
"""Number of the largest faces of the convex hull that are tried; chosen by hand."""
SAME_END = 0.9
"""Cosine of the angle, 26 degrees, within which two planes are the same end; chosen by hand."""
SAME = 0.995
"""Cosine of the angle, 6 degrees, within which no second plane is tried; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CutPlane:
    """A plane at which the image ended: the bone beyond it is unknown."""

    point_mm: Floats
    """(3,) a point of the plane, LPS."""
    normal: Floats
    """(3,) unit vector, pointing out of the bone."""

    def __post_init__(self) -> None:
        freeze_fields(self, "point_mm", "normal")

    def depth_mm(self, points_mm: Floats) -> Floats:
        """Return the distance [mm] of points (..., 3) inside the plane; negative beyond it."""
        return np.asarray((self.point_mm - points_mm) @ self.normal)


def cut_planes(surface: TriangleSurface) -> tuple[CutPlane, ...]:
    """Find the flat ends of a bone: planes that touch it from outside and contain much of its surface."""
    hull = ConvexHull(surface.vertices_mm)
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    # The hull of a rounded bone has little area in any direction; a face that spans a hollow contains no bone.
    size = _areas(surface.vertices_mm[hull.simplices])
    large = np.argsort(-size)[:_CANDIDATES]
    spread = (normals[large] @ normals.T > ALIGNED) @ size
    planes: list[CutPlane] = []
    round_ends: list[Floats] = []
    for simplex in large[np.argsort(-spread)[: np.count_nonzero(spread > LEAST_CUT_MM2 / 2)]]:
        normal = normals[simplex]
        if any(plane.normal @ normal > SAME_END for plane in planes) or any(end @ normal > SAME for end in round_ends):
            continue
        plane = _flat_end(surface, normal, offsets[simplex])
        if plane is None:
            round_ends.append(normal)
        elif not any(known.normal @ plane.normal > SAME_END for known in planes):
            planes.append(plane)
    return tuple(planes)


def _flat_end(surface: TriangleSurface, normal: Floats, offset: float) -> CutPlane | None:
    """Fit a plane to the faces about one that touches a bone; None where they are too few or rounded."""
    near = np.flatnonzero(surface.face_normals @ normal > LEANING)
    area, facing, middle = surface.face_areas_mm2[near], surface.face_normals[near], surface.corners_mm[near].mean(1)
    point = -offset * normal
    for _ in range(3):
        within = (facing @ normal > ALIGNED) & (np.abs((middle - point) @ normal) < FLAT_MM)
        if area[within].sum() < LEAST_CUT_MM2 / 2:
            return None
        point = np.average(middle[within], axis=0, weights=area[within])
        mean = area[within] @ facing[within]
        normal = mean / np.linalg.norm(mean)
    leaning = np.arccos(np.clip(facing[within] @ normal, -1, 1))
    even = np.sqrt(np.average(leaning**2, weights=area[within])) < EVEN
    return CutPlane(point_mm=point, normal=normal) if even and area[within].sum() > LEAST_CUT_MM2 else None


def known_faces(surface: TriangleSurface, planes: tuple[CutPlane, ...], margin_mm: float) -> Mask:
    """Return which faces (T,) belong to the bone itself: not within a margin of a cut, nor at an open rim."""
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, place, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    closed = (count[place.reshape(-1)].reshape(-1, 3) > 1).all(1)
    return np.asarray(closed & known_points(surface.corners_mm.mean(1), planes, margin_mm))


def known_points(points_mm: Floats, planes: tuple[CutPlane, ...], margin_mm: float) -> Mask:
    """Return which points (..., 3) lie within all planes by more than a margin."""
    known = np.ones(np.shape(points_mm)[:-1], bool)
    for plane in planes:
        known &= plane.depth_mm(points_mm) > margin_mm
    return known


def at_cut(surface: TriangleSurface) -> Mask:
    """Return which vertices (V,) lie on a flat end at which the image cut the bone: nothing is measured there."""
    return ~known_points(surface.vertices_mm, cut_planes(surface), FLAT_MM)


def _areas(corners: Floats) -> Floats:
    """Return the areas (n,) of triangles (n, 3, 3)."""
    return np.asarray(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    )
