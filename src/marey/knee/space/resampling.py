"""Working grids along the body's axes: a volume smoothed, resampled onto them, and answers carried back."""

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask
from marey.kernels import kernel
from marey.knee.space.volume import Grid, Volume

_WITHIN = 0.999


def upright_grid(grid: Grid, spacing_mm: float) -> Grid:
    """Lay a grid of cubes along left, back and head over the whole of another grid.

    Args:
        grid: Turned as it may be.
        spacing_mm: Edge of a cube.
    """
    ends = np.array([(0, count - 1) for count in grid.shape[::-1]], dtype=float)
    corners = grid.lps(np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3))
    low = corners.min(axis=0)
    counts = np.floor((corners.max(axis=0) - low) / spacing_mm + 1e-6).astype(int) + 1
    lps_from_voxel = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    lps_from_voxel[:3, 3] = low
    i, j, k = counts.tolist()
    return Grid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def part_of(grid: Grid, box: tuple[slice, ...]) -> Grid:
    """Give the grid of a part of an array: its slices along k, j, i."""
    bounds = [each.indices(count) for each, count in zip(box, grid.shape, strict=True)]
    lps_from_voxel = grid.lps_from_voxel.copy()
    lps_from_voxel[:3, 3] = grid.lps(np.array([float(start) for start, _, _ in bounds[::-1]]))
    k, j, i = (stop - start for start, stop, _ in bounds)
    return Grid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def resampled(values: np.ndarray, source: Grid, target: Grid, *, outside: float = 0.0, order: int = 1) -> np.ndarray:
    """Read an array of one grid at the voxels of another.

    Args:
        values: (k, j, i) on the source.
        source: Grid of the values.
        target: Grid of the answer.
        outside: What to give where the source does not reach.
        order: 0 nearest, 1 linear.
    """
    matrix = np.linalg.inv(source.lps_from_voxel) @ target.lps_from_voxel
    turned = matrix[[2, 1, 0, 3]][:, [2, 1, 0, 3]]
    given: np.ndarray = ndimage.affine_transform(
        values, turned[:3, :3], turned[:3, 3], output_shape=target.shape, order=order, cval=outside
    )
    return given


def smoothed(values: np.ndarray, grid: Grid, sigma_mm: float) -> np.ndarray:
    """Smooth by a Gaussian that is round in millimetres, whatever the voxels."""
    sigma = [sigma_mm / spacing for spacing in grid.array_spacing_mm]
    given: np.ndarray = ndimage.gaussian_filter(np.asarray(values, dtype=np.float32), sigma)
    return given


def on_grid(volume: Volume, target: Grid, sigma_mm: float) -> np.ndarray:
    """Give an image smoothed and read on another grid."""
    return resampled(smoothed(volume.intensity, volume.grid, sigma_mm), volume.grid, target)


def reach(source: Grid, target: Grid) -> Mask:
    """(k, j, i) of the target: true where the source reaches; not in the corners beside one that is turned."""
    return np.asarray(resampled(np.ones(source.shape, dtype=np.float32), source, target) > _WITHIN)


def onward(values: np.ndarray, within: Mask) -> np.ndarray:
    """Give an array that goes on outside a mask as it is at the nearest place within.

    Args:
        values: (k, j, i).
        within: (k, j, i) where they are known.
    """
    if within.all() or not within.any():
        return values
    nearest = ndimage.distance_transform_edt(~within, return_distances=False, return_indices=True)
    given: np.ndarray = values[tuple(nearest)]
    return given


def read_at(values: np.ndarray, grid: Grid, lps_mm: Floats, *, outside: float = 0.0) -> Floats:
    """Read an array at positions (..., 3), linearly: as SciPy's `map_coordinates` does, with less ado for few."""
    voxels = np.ascontiguousarray(grid.voxels(lps_mm).reshape(-1, 3))
    found = np.empty(len(voxels), values.dtype)
    # A view that cannot be written: Numba compiles anew for arrays that can.
    readable = np.ascontiguousarray(values).view()
    readable.setflags(write=False)
    _read_linearly(readable, voxels, outside, found)
    return found.reshape(np.shape(lps_mm)[:-1])


@kernel
def _read_linearly(values, voxels, outside, found):  # pragma: no cover - compiled
    """Write what an array (k, j, i) is at fractional voxels (n, 3) i, j, k."""
    last_k, last_j, last_i = values.shape[0] - 1, values.shape[1] - 1, values.shape[2] - 1
    for n in range(len(voxels)):
        i, j, k = voxels[n, 0], voxels[n, 1], voxels[n, 2]
        if not (0.0 <= i <= last_i and 0.0 <= j <= last_j and 0.0 <= k <= last_k):
            found[n] = outside
            continue
        i0, j0, k0 = int(i), int(j), int(k)
        i1, j1, k1 = min(i0 + 1, last_i), min(j0 + 1, last_j), min(k0 + 1, last_k)
        u, v, w = i - i0, j - j0, k - k0
        near = (1.0 - v) * ((1.0 - u) * values[k0, j0, i0] + u * values[k0, j0, i1])
        near += v * ((1.0 - u) * values[k0, j1, i0] + u * values[k0, j1, i1])
        far = (1.0 - v) * ((1.0 - u) * values[k1, j0, i0] + u * values[k1, j0, i1])
        far += v * ((1.0 - u) * values[k1, j1, i0] + u * values[k1, j1, i1])
        found[n] = (1.0 - w) * near + w * far
