"""Triangle mesh of a bone or a sheet of cartilage."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class TriangleSurface:
    """Triangle mesh whose faces are counter-clockwise as seen from outside."""

    vertices_mm: Floats
    """(V, 3) LPS."""
    faces: Integers
    """(T, 3) indices of the vertices of each face."""

    def __post_init__(self) -> None:
        freeze_fields(self, "vertices_mm")
        freeze_fields(self, "faces", dtype=np.int64)

    @cached_property
    def corners_mm(self) -> Floats:
        """(T, 3, 3) the three corners of each face."""
        return self.vertices_mm[self.faces]

    @cached_property
    def vertex_normals(self) -> Floats:
        """(V, 3) outward unit normals: the area-weighted mean of the adjacent faces; zero without a face."""
        sums = np.zeros_like(self.vertices_mm)
        for corner in range(3):
            np.add.at(sums, self.faces[:, corner], self._twice_areas)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.asarray(np.divide(sums, length, out=np.zeros_like(sums), where=length > 0))

    @cached_property
    def _twice_areas(self) -> Floats:
        first, second, third = np.moveaxis(self.corners_mm, 1, 0)
        return np.cross(second - first, third - first)

    @cached_property
    def face_areas_mm2(self) -> Floats:
        """(T,) area of each face."""
        return np.asarray(np.linalg.norm(self._twice_areas, axis=1) / 2)

    @cached_property
    def vertex_areas_mm2(self) -> Floats:
        """(V,) a third of the area of the faces about each vertex."""
        thirds = np.repeat(self.face_areas_mm2 / 3, 3)
        return np.asarray(np.bincount(self.faces.ravel(), thirds, len(self.vertices_mm)), np.float64)

    @cached_property
    def face_normals(self) -> Floats:
        """(T, 3) outward unit normals; zero for a face without area."""
        length = 2 * self.face_areas_mm2[:, None]
        return np.divide(self._twice_areas, length, out=np.zeros_like(self._twice_areas), where=length > 0)

    @property
    def area_mm2(self) -> float:
        """Total area of the faces."""
        return float(self.face_areas_mm2.sum())

    @property
    def volume_mm3(self) -> float:
        """Enclosed volume; positive when the faces are oriented outward."""
        return float(np.einsum("ti,ti->", self.corners_mm[:, 0], self._twice_areas) / 6)
