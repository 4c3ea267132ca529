import numpy as np
import pytest
from scipy import ndimage

from marey.knee.space.resampling import on_grid, read_at, resampled, smoothed, upright_grid
from marey.knee.space.volume import Volume, VoxelGrid


def turned_grid(flip: bool) -> VoxelGrid:
    """Sagittal slices, tilted by 0.2 rad."""
    c, s = np.cos(0.2), np.sin(0.2)
    axes = np.array([[0.0, 0.0, -1.0 if flip else 1.0], [c, -s, 0.0], [-s, -c, 0.0]])
    lps_from_voxel = np.eye(4)
    lps_from_voxel[:3, :3] = axes * [0.7, 0.7, 2.0]
    lps_from_voxel[:3, 3] = [5.0, -8.0, 12.0]
    return VoxelGrid(shape=(12, 40, 44), lps_from_voxel=lps_from_voxel)


def linear(grid: VoxelGrid) -> np.ndarray:
    k, j, i = np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")
    return grid.lps(np.stack([i, j, k], axis=-1).astype(float)) @ np.array([1.0, -2.0, 0.5]) + 100


@pytest.mark.parametrize("flip", [False, True])
def test_a_linear_image_reads_the_same_on_an_upright_grid(flip):
    grid = turned_grid(flip)
    upright = upright_grid(grid, 1.0)
    found = resampled(linear(grid), grid, upright, outside=np.nan)
    known = np.isfinite(found)
    assert known.mean() > 0.5
    np.testing.assert_allclose(found[known], linear(upright)[known], atol=1e-9)
    np.testing.assert_allclose(upright.lps_from_voxel[:3, :3], np.eye(3))


def test_the_upright_grid_contains_every_voxel():
    grid = turned_grid(True)
    upright = upright_grid(grid, 1.0)
    ends = upright.voxels(grid.lps(np.array([[0.0, 0, 0], [43, 39, 11], [43, 0, 11], [0, 39, 0]])))
    assert (ends > -1e-9).all()
    assert (ends < np.array(upright.shape[::-1])).all()


def test_places_are_read_linearly_and_nothing_is_read_outside():
    grid = turned_grid(False)
    places = grid.lps(np.array([[3.5, 4.25, 2.5], [-3.0, 0.0, 0.0]]))
    found = read_at(linear(grid), grid, places, outside=np.nan)
    np.testing.assert_allclose(found[0], places[0] @ [1.0, -2.0, 0.5] + 100)
    assert np.isnan(found[1])


def test_reading_places_is_what_scipy_does(rng):
    grid = turned_grid(True)
    values = rng.normal(size=grid.shape).astype(np.float32)
    values[:3] = np.nan
    voxels = np.concatenate([rng.uniform(-3, 45, (500, 3)), np.round(rng.uniform(0, 11, (50, 3))), [[43.0, 39, 11]]])
    places = grid.lps(voxels)
    wanted = ndimage.map_coordinates(values, grid.voxels(places)[:, ::-1].T, order=1, cval=-7.0)
    np.testing.assert_allclose(read_at(values, grid, places, outside=-7.0), wanted, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_resampling_is_what_scipy_does(rng, dtype):
    grid = turned_grid(True)
    plain = VoxelGrid(shape=(31, 61, 61), lps_from_voxel=np.diag([0.5, 0.5, 1.0, 1.0]))
    values = {each.shape: rng.normal(size=each.shape).astype(dtype) for each in (grid, plain)}
    for source, target in ((grid, upright_grid(grid, 1.0)), (plain, upright_grid(plain, 0.7)), (plain, plain)):
        given = values[source.shape].copy()
        given[5, :3] = np.nan
        matrix = (np.linalg.inv(source.lps_from_voxel) @ target.lps_from_voxel)[[2, 1, 0, 3]][:, [2, 1, 0, 3]]
        wanted = ndimage.affine_transform(
            given, matrix[:3, :3], matrix[:3, 3], output_shape=target.shape, order=1, cval=-7.0
        )
        found = resampled(given, source, target, outside=-7.0)
        assert found.dtype == dtype
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_smoothing_is_as_wide_in_millimetres_along_every_axis():
    grid = VoxelGrid(shape=(31, 61, 61), lps_from_voxel=np.diag([0.5, 0.5, 1.0, 1.0]))
    point = np.zeros(grid.shape)
    point[15, 30, 30] = 1.0
    spread = smoothed(point, grid, 2.0)
    axes = [np.arange(n) * s for n, s in zip(grid.shape, grid.array_spacing_mm, strict=True)]
    for axis in range(3):
        profile = spread.sum(axis=tuple(other for other in range(3) if other != axis))
        mean = (profile * axes[axis]).sum() / profile.sum()
        width = np.sqrt((profile * (axes[axis] - mean) ** 2).sum() / profile.sum())
        assert width == pytest.approx(2.0, rel=0.03)
    volume = Volume(intensity=point, grid=grid)
    assert on_grid(volume, upright_grid(grid, 1.0), 2.0).shape == (31, 31, 31)
