"""Where a bone's surface is not the bone's: the flat ends at which the image was cut off, and open rims."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from marey.arrays import Floats, Mask, frozen
from marey.knee.surface import Surface

LEAST_CUT_MM2 = 200.0
"""A flat end is at least so large: a rounded one of 50 mm radius has 60 mm2 so near a plane."""
FLAT_MM = 0.2
"""It lies so near a plane; smoothing rounds only its edge by more."""
ALIGNED = 0.99
"""Cosine of the angle by which its faces may lean, 8 degrees."""
_CANDIDATES = 300
SAME_END = 0.9
"""Planes of normals nearer than that are one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CutPlane:
    """A plane at which the image ended: what lies beyond is not known."""

    point_mm: Floats
    """(3,)."""
    normal: Floats
    """(3,) unit, out of the bone."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "point_mm", frozen(self.point_mm))
        object.__setattr__(self, "normal", frozen(self.normal))

    def depth_mm(self, points_mm: Floats) -> Floats:
        """Tell how far points (..., 3) lie within the plane; negative beyond."""
        return np.asarray((self.point_mm - points_mm) @ self.normal)


def cut_planes(surface: Surface) -> tuple[CutPlane, ...]:
    """Find the flat ends of a bone: planes that touch it from outside and that much of its surface lies in."""
    hull = ConvexHull(surface.vertices_mm)
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    # The hull of a rounded bone has little of its own in any direction; one that spans a hollow has no bone in it.
    size = _areas(surface.vertices_mm[hull.simplices])
    large = np.argsort(-size)[:_CANDIDATES]
    spread = (normals[large] @ normals.T > ALIGNED) @ size
    area, middle = surface.face_areas_mm2, surface.corners_mm.mean(1)
    facing = surface.face_normals
    planes: list[CutPlane] = []
    for simplex in large[np.argsort(-spread)[: np.count_nonzero(spread > LEAST_CUT_MM2)]]:
        normal, offset = normals[simplex], offsets[simplex]
        if any(plane.normal @ normal > SAME_END for plane in planes):
            continue
        within = (facing @ normal > ALIGNED) & (np.abs(middle @ normal + offset) < FLAT_MM)
        if area[within].sum() < LEAST_CUT_MM2:
            continue
        point = np.average(middle[within], axis=0, weights=area[within])
        mean = area[within] @ facing[within]
        planes.append(CutPlane(point_mm=point, normal=mean / np.linalg.norm(mean)))
    return tuple(planes)


def known_faces(surface: Surface, planes: tuple[CutPlane, ...], margin_mm: float) -> Mask:
    """Tell which faces (T,) are the bone's own: not within a margin of a cut, nor at an open rim."""
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, place, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    closed = (count[place.reshape(-1)].reshape(-1, 3) > 1).all(1)
    return np.asarray(closed & known_points(surface.corners_mm.mean(1), planes, margin_mm))


def known_points(points_mm: Floats, planes: tuple[CutPlane, ...], margin_mm: float) -> Mask:
    """Tell which points (..., 3) lie within all planes by more than a margin."""
    known = np.ones(np.shape(points_mm)[:-1], bool)
    for plane in planes:
        known &= plane.depth_mm(points_mm) > margin_mm
    return known


def _areas(corners: Floats) -> Floats:
    """Give the areas (n,) of triangles (n, 3, 3)."""
    return np.asarray(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    )
