import numpy as np

from marey.knee.space.volume import VoxelGrid


def oblique_left_handed_grid() -> VoxelGrid:
    matrix = np.eye(4)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= -np.sign(np.linalg.det(turn))
    matrix[:3, :3] = turn * (0.3, 0.4, 1.5)
    matrix[:3, 3] = (-20.0, 35.0, 100.0)
    return VoxelGrid(shape=(8, 30, 40), lps_from_voxel=matrix)


def test_voxels_and_positions_are_inverse_of_each_other_in_a_left_handed_oblique_grid():
    grid = oblique_left_handed_grid()
    voxels = np.random.default_rng(2).uniform(-5, 50, (20, 3))
    np.testing.assert_allclose(grid.voxels(grid.lps(voxels)), voxels, atol=1e-10)


def test_spacings_are_in_the_order_of_voxel_and_of_array():
    grid = oblique_left_handed_grid()
    np.testing.assert_allclose(grid.spacing_mm, (0.3, 0.4, 1.5))
    np.testing.assert_allclose(grid.array_spacing_mm, (1.5, 0.4, 0.3))
    np.testing.assert_allclose(grid.voxel_mm3, 0.3 * 0.4 * 1.5)
