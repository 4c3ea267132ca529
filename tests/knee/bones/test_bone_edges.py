import numpy as np
import pytest

from marey.knee.bones.bone_edges import BoneEdgeSettings, BoneImage, refine_edge
from marey.knee.bones.outer_edge import OuterEdgeSettings
from marey.knee.space.resampling import smoothed
from marey.knee.space.volume import VoxelGrid

SPACING = 0.6
RADIUS = 13.0


def ball() -> tuple[np.ndarray, VoxelGrid]:
    """Depth [mm] in a ball in the middle of a cube of 42 mm."""
    grid = VoxelGrid(shape=(70, 70, 70), lps_from_voxel=np.diag([SPACING, SPACING, SPACING, 1.0]))
    k, j, i = np.meshgrid(*[np.arange(n) * SPACING - 20.7 for n in grid.shape], indexing="ij")
    return RADIUS - np.sqrt(k**2 + j**2 + i**2), grid


def imaged(levels: np.ndarray, grid: VoxelGrid, rng: np.random.Generator, noise: float) -> np.ndarray:
    blurred = smoothed(levels, grid, 0.4)
    return np.hypot(blurred + rng.normal(0, noise, grid.shape), rng.normal(0, noise, grid.shape))


def radius_of(distance: np.ndarray) -> float:
    """Radius of the ball with the volume that lies inside."""
    return float(((distance > 0).sum() * SPACING**3 * 0.75 / np.pi) ** (1 / 3))


@pytest.mark.slow
def test_a_film_of_fat_before_muscle_is_no_dark_marrow(rng):
    depth, grid = ball()
    levels = np.where(depth > 0, 15.0, np.where(depth > -2.5, 25.0, 50.0))
    levels[:, 35:] = np.where(depth > 0, 15.0, 25.0)[:, 35:]
    piece = BoneImage(
        intensity=imaged(levels, grid, rng, 4.0),
        distance_mm=depth - 1.5,
        prior_nats=np.zeros(grid.shape),
        grid=grid,
    )
    # Halfway to muscle the whole film, 2.5 mm, would be marrow over half the ball.
    assert radius_of(refine_edge(piece, "dark")) == pytest.approx(RADIUS, abs=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("line_mm", [0.8, 1.4])
def test_the_black_line_about_bright_marrow_is_added_to_its_outer_end(rng, line_mm):
    depth, grid = ball()
    levels = np.where(depth > line_mm, 120.0, np.where(depth > 0, 12.0, 138.0))
    piece = BoneImage(
        intensity=imaged(levels, grid, rng, 4.0), distance_mm=depth - 2.0, prior_nats=np.zeros(grid.shape), grid=grid
    )
    # A third of a voxel: the line is no wider than one or two.
    assert radius_of(refine_edge(piece, "bright")) == pytest.approx(RADIUS, abs=0.25)


@pytest.mark.slow
def test_muscle_alone_leaves_the_edge_halfway(rng):
    depth, grid = ball()
    levels = np.where(depth > 0, 15.0, 50.0)
    piece = BoneImage(
        intensity=imaged(levels, grid, rng, 4.0), distance_mm=depth - 1.0, prior_nats=np.zeros(grid.shape), grid=grid
    )
    refined = refine_edge(piece, "dark")
    assert radius_of(refined) == pytest.approx(RADIUS, abs=0.15)
    without = refine_edge(piece, "dark", settings=BoneEdgeSettings(outer_edge=OuterEdgeSettings(rounds=0)))
    assert np.abs(refined - without).max() > 0.01


@pytest.mark.slow
def test_a_film_of_fat_before_bright_muscle_is_no_bone_with_a_black_cortex(rng):
    depth, grid = ball()
    levels = np.where(depth > 1, 15.0, np.where(depth > 0, 4.0, np.where(depth > -2.5, 25.0, 80.0)))
    levels[:, 30:] = np.where(depth > 0, levels, 25.0)[:, 30:]
    piece = BoneImage(
        intensity=imaged(levels, grid, rng, 4.0),
        distance_mm=depth + 1.0,
        prior_nats=np.zeros(grid.shape),
        grid=grid,
        no_signal=5.0,
    )
    # Halfway between marrow and muscle the film would be bone, a fifth of the radius.
    assert radius_of(refine_edge(piece, "dark")) == pytest.approx(RADIUS, abs=0.15)
