import numpy as np
import pytest

from marey.knee.bones.outer_edge import at_half_level
from marey.knee.space.resampling import smoothed
from marey.knee.space.volume import VoxelGrid

RADIUS = 13.0
SPACING = np.array([1.2, 0.5, 0.5])
VOXEL = float(SPACING.prod())


def ball() -> tuple[np.ndarray, VoxelGrid]:
    """Depth [mm] in a ball, in slices as thick as knees are scanned in."""
    grid = VoxelGrid(shape=(32, 76, 76), lps_from_voxel=np.diag([*SPACING[::-1], 1.0]))
    axes = [(np.arange(n) - (n - 1) / 2) * step for n, step in zip(grid.shape, SPACING, strict=True)]
    k, j, i = np.meshgrid(*axes, indexing="ij")
    return RADIUS - np.sqrt(k**2 + j**2 + i**2), grid


def imaged(levels: np.ndarray, grid: VoxelGrid, rng: np.random.Generator, noise: float = 4.0) -> np.ndarray:
    blurred = smoothed(levels, grid, 0.45)
    return np.hypot(blurred + rng.normal(0, noise, grid.shape), rng.normal(0, noise, grid.shape))


def radius_of(distance: np.ndarray) -> float:
    return float(((distance > 0).sum() * VOXEL * 0.75 / np.pi) ** (1 / 3))


@pytest.mark.slow
@pytest.mark.parametrize("off_mm", [-0.5, 0.0, 0.5])
@pytest.mark.parametrize("outside", [25.0, 50.0, 110.0])
def test_a_bone_with_a_black_cortex_ends_where_its_cortex_ends(rng, off_mm, outside):
    depth, grid = ball()
    levels = np.where(depth > 1.0, 15.0, np.where(depth > 0, 0.0, outside))
    image = imaged(levels, grid, rng)
    air = float(np.median(np.hypot(*rng.normal(0, 4.0, (2, 9999)))))
    moved = at_half_level(image, depth + off_mm, grid, no_signal=air)
    # The tolerance is 20 % of the width of a voxel.
    assert radius_of(moved) == pytest.approx(RADIUS, abs=0.1)


def test_without_a_line_the_edge_lies_halfway_between_marrow_and_cartilage(rng):
    depth, grid = ball()
    moved = at_half_level(imaged(np.where(depth > 0, 15.0, 110.0), grid, rng), depth - 0.6, grid, no_signal=5.0)
    assert radius_of(moved) == pytest.approx(RADIUS, abs=0.1)


def test_a_film_of_fat_before_bright_muscle_is_where_the_edge_stops(rng):
    depth, grid = ball()
    levels = np.where(depth > 1.0, 15.0, np.where(depth > 0, 0.0, np.where(depth > -2.0, 25.0, 90.0)))
    moved = at_half_level(imaged(levels, grid, rng), depth + 0.4, grid, no_signal=5.0)
    assert radius_of(moved) == pytest.approx(RADIUS, abs=0.2)


def test_what_shows_no_edge_stays_where_it_was(rng):
    depth, grid = ball()
    moved = at_half_level(imaged(np.full(grid.shape, 15.0), grid, rng), depth, grid, no_signal=5.0)
    assert np.abs(moved - depth).max() < 0.05
