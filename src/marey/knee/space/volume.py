"""MR volumes and label volumes, with their position in the scanner."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, Mask, freeze_fields
from marey.knee.space.structures import LABELS


@dataclass(frozen=True, eq=False, kw_only=True)
class VoxelGrid:
    """Position of the voxels of a volume: voxel (i, j, k) is `array[k, j, i]`, its centre at whole numbers."""

    shape: tuple[int, int, int]
    """Numbers of voxels in the order of NumPy: along k, j, i."""
    lps_from_voxel: Floats
    """(4, 4): homogeneous (i, j, k) to LPS [mm]. Its determinant may be negative."""

    def __post_init__(self) -> None:
        freeze_fields(self, "lps_from_voxel")

    @property
    def spacing_mm(self) -> Floats:
        """(3,) spacing of the voxels along i, j, k."""
        return np.asarray(np.linalg.norm(self.lps_from_voxel[:3, :3], axis=0))

    @property
    def array_spacing_mm(self) -> tuple[float, float, float]:
        """Spacing along the array's axes k, j, i, as SciPy's `sampling` expects it."""
        i, j, k = self.spacing_mm.tolist()
        return k, j, i

    @property
    def voxel_mm3(self) -> float:
        """Volume of a voxel."""
        return float(abs(np.linalg.det(self.lps_from_voxel[:3, :3])))

    def lps(self, voxels: Floats) -> Floats:
        """Return positions (..., 3) [mm] of fractional voxels (i, j, k)."""
        return np.asarray(voxels) @ self.lps_from_voxel[:3, :3].T + self.lps_from_voxel[:3, 3]

    def voxels(self, lps_mm: Floats) -> Floats:
        """Return fractional voxels (i, j, k) of positions (..., 3) [mm]; outside the volume too."""
        return (np.asarray(lps_mm) - self.lps_from_voxel[:3, 3]) @ self._voxel_from_mm.T

    @cached_property
    def _voxel_from_mm(self) -> Floats:
        return np.linalg.inv(self.lps_from_voxel[:3, :3])


@dataclass(frozen=True, eq=False, kw_only=True)
class Volume:
    """An MR image."""

    intensity: NDArray[np.float32]
    """(k, j, i) in the scanner's unit."""
    grid: VoxelGrid

    def __post_init__(self) -> None:
        freeze_fields(self, "intensity", dtype=np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class Labels:
    """The structure of each voxel."""

    labels: NDArray[np.uint8]
    """(k, j, i) numbers of `LABELS`, 0 elsewhere."""
    grid: VoxelGrid

    def __post_init__(self) -> None:
        freeze_fields(self, "labels", dtype=np.uint8)

    def mask(self, structure: str) -> Mask:
        """(k, j, i) true in the structure."""
        return np.asarray(self.labels == LABELS[structure])
