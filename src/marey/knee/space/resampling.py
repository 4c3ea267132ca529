"""Grids along the body's axes, and resampling of volumes between grids."""

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask
from marey.compiled.kernels import kernel
from marey.knee.space.volume import Volume, VoxelGrid

_WITHIN = 0.999
"""Least interpolation weight of the source within its own image: 1, less a margin for rounding."""


def upright_grid(grid: VoxelGrid, spacing_mm: float) -> VoxelGrid:
    """Return a grid of cubes along left, back and head that covers another grid.

    Args:
        grid: In any orientation.
        spacing_mm: Edge of a cube.
    """
    ends = np.array([(0, count - 1) for count in grid.shape[::-1]], dtype=float)
    corners = grid.lps(np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3))
    low = corners.min(axis=0)
    counts = np.floor((corners.max(axis=0) - low) / spacing_mm + 1e-6).astype(int) + 1
    lps_from_voxel = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    lps_from_voxel[:3, 3] = low
    i, j, k = counts.tolist()
    return VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def part_of(grid: VoxelGrid, box: tuple[slice, ...]) -> VoxelGrid:
    """Return the grid of a part of an array: its slices along k, j, i."""
    bounds = [each.indices(count) for each, count in zip(box, grid.shape, strict=True)]
    lps_from_voxel = grid.lps_from_voxel.copy()
    lps_from_voxel[:3, 3] = grid.lps(np.array([float(start) for start, _, _ in bounds[::-1]]))
    k, j, i = (stop - start for start, stop, _ in bounds)
    return VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def resampled(
    values: np.ndarray, source: VoxelGrid, target: VoxelGrid, *, outside: float = 0.0, order: int = 1
) -> np.ndarray:
    """Read an array of one grid at the voxels of another.

    Args:
        values: (k, j, i) on the source.
        source: Grid of the values.
        target: Grid of the result.
        outside: Value where the source does not reach.
        order: 0 for nearest-neighbour, 1 for linear interpolation.
    """
    matrix = np.linalg.inv(source.lps_from_voxel) @ target.lps_from_voxel
    turned = matrix[[2, 1, 0, 3]][:, [2, 1, 0, 3]]
    if order == 1 and values.dtype in (np.float32, np.float64):
        found = np.empty(target.shape, values.dtype)
        _resample(_readable(values), np.ascontiguousarray(turned[:3]), outside, found)
        return found
    result: np.ndarray = ndimage.affine_transform(
        values, turned[:3, :3], turned[:3, 3], output_shape=target.shape, order=order, cval=outside
    )
    return result


def smoothed(values: np.ndarray, grid: VoxelGrid, sigma_mm: float) -> np.ndarray:
    """Smooth by a Gaussian that is isotropic in millimetres, for voxels of any shape."""
    sigma = [sigma_mm / spacing for spacing in grid.array_spacing_mm]
    result: np.ndarray = ndimage.gaussian_filter(np.asarray(values, dtype=np.float32), sigma)
    return result


def on_grid(volume: Volume, target: VoxelGrid, sigma_mm: float) -> np.ndarray:
    """Smooth an image and resample it to another grid."""
    return resampled(smoothed(volume.intensity, volume.grid, sigma_mm), volume.grid, target)


def reach(source: VoxelGrid, target: VoxelGrid) -> Mask:
    """(k, j, i) of the target: true within the source, whose corners a rotated target exceeds."""
    return np.asarray(resampled(np.ones(source.shape, dtype=np.float32), source, target) > _WITHIN)


def extrapolated(values: np.ndarray, within: Mask) -> np.ndarray:
    """Return an array that continues outside a mask with the value of the nearest voxel within.

    Args:
        values: (k, j, i).
        within: (k, j, i) true where they are known.
    """
    if within.all() or not within.any():
        return values
    nearest = ndimage.distance_transform_edt(~within, return_distances=False, return_indices=True)
    result: np.ndarray = values[tuple(nearest)]
    return result


def read_at(values: np.ndarray, grid: VoxelGrid, lps_mm: Floats, *, outside: float = 0.0) -> Floats:
    """Interpolate an array linearly at positions (..., 3): as SciPy's `map_coordinates`, faster for few positions."""
    voxels = np.ascontiguousarray(grid.voxels(lps_mm).reshape(-1, 3))
    found = np.empty(len(voxels), values.dtype)
    _read_linearly(_readable(values), voxels, outside, found)
    return found.reshape(np.shape(lps_mm)[:-1])


def _readable(values: np.ndarray) -> np.ndarray:
    """Return a read-only view: Numba would compile another specialisation for writable arrays."""
    readable = np.ascontiguousarray(values).view()
    readable.setflags(write=False)
    return readable


@kernel
def _linear(values, k, j, i, outside):  # pragma: no cover - compiled
    """Return the value of an array (k, j, i) at a fractional voxel."""
    last_k, last_j, last_i = values.shape[0] - 1, values.shape[1] - 1, values.shape[2] - 1
    if not (0.0 <= i <= last_i and 0.0 <= j <= last_j and 0.0 <= k <= last_k):
        return outside
    i0, j0, k0 = int(i), int(j), int(k)
    i1, j1, k1 = min(i0 + 1, last_i), min(j0 + 1, last_j), min(k0 + 1, last_k)
    u, v, w = i - i0, j - j0, k - k0
    near = (1.0 - v) * ((1.0 - u) * values[k0, j0, i0] + u * values[k0, j0, i1])
    near += v * ((1.0 - u) * values[k0, j1, i0] + u * values[k0, j1, i1])
    far = (1.0 - v) * ((1.0 - u) * values[k1, j0, i0] + u * values[k1, j0, i1])
    far += v * ((1.0 - u) * values[k1, j1, i0] + u * values[k1, j1, i1])
    return (1.0 - w) * near + w * far


@kernel
def _read_linearly(values, voxels, outside, found):  # pragma: no cover - compiled
    """Write the values of an array (k, j, i) at fractional voxels (n, 3) i, j, k."""
    for n in range(len(voxels)):
        found[n] = _linear(values, voxels[n, 2], voxels[n, 1], voxels[n, 0], outside)


@kernel
def _resample(values, matrix, outside, found):  # pragma: no cover - compiled
    """Write the values of an array (k, j, i) at the voxels of another one, whose places in it a matrix (3, 4) gives."""
    for k in range(found.shape[0]):
        for j in range(found.shape[1]):
            for i in range(found.shape[2]):
                # The sums in this order have the same rounding errors, and so the same edges, as SciPy's.
                from_k = matrix[0, 3] + matrix[0, 0] * k + matrix[0, 1] * j + matrix[0, 2] * i
                from_j = matrix[1, 3] + matrix[1, 0] * k + matrix[1, 1] * j + matrix[1, 2] * i
                from_i = matrix[2, 3] + matrix[2, 0] * k + matrix[2, 1] * j + matrix[2, 2] * i
                found[k, j, i] = _linear(values, from_k, from_j, from_i, outside)
