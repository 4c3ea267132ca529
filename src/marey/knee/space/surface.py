"""A closed surface of triangles: a bone, or a sheet of cartilage."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """Triangles whose corners turn against the clock as seen from outside."""

    vertices_mm: Floats
    """(V, 3) LPS."""
    faces: Integers
    """(T, 3)."""

    def __post_init__(self) -> None:
        freeze_fields(self, "vertices_mm")
        freeze_fields(self, "faces", dtype=np.int64)

    @cached_property
    def corners_mm(self) -> Floats:
        """(T, 3, 3) the three corners of each face."""
        return self.vertices_mm[self.faces]

    @cached_property
    def vertex_normals(self) -> Floats:
        """(V, 3) unit normals, outward: those of the faces about, by their areas; zero where no face is."""
        sums = np.zeros_like(self.vertices_mm)
        for corner in range(3):
            np.add.at(sums, self.faces[:, corner], self._twice_areas)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.divide(sums, length, out=np.zeros_like(sums), where=length > 0)

    @cached_property
    def _twice_areas(self) -> Floats:
        first, second, third = np.moveaxis(self.corners_mm, 1, 0)
        return np.cross(second - first, third - first)

    @cached_property
    def face_areas_mm2(self) -> Floats:
        """(T,)."""
        return np.asarray(np.linalg.norm(self._twice_areas, axis=1) / 2)

    @cached_property
    def vertex_areas_mm2(self) -> Floats:
        """(V,) a third of the faces about each vertex."""
        thirds = np.repeat(self.face_areas_mm2 / 3, 3)
        return np.asarray(np.bincount(self.faces.ravel(), thirds, len(self.vertices_mm)), np.float64)

    @cached_property
    def face_normals(self) -> Floats:
        """(T, 3) unit normals, outward; zero of a face without area."""
        length = 2 * self.face_areas_mm2[:, None]
        return np.divide(self._twice_areas, length, out=np.zeros_like(self._twice_areas), where=length > 0)

    @property
    def area_mm2(self) -> float:
        """Area of all faces."""
        return float(self.face_areas_mm2.sum())

    @property
    def volume_mm3(self) -> float:
        """Volume within; positive when the faces turn outward."""
        return float(np.einsum("ti,ti->", self.corners_mm[:, 0], self._twice_areas) / 6)
