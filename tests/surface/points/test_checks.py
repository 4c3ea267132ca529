import numpy as np
from tests import scenes

from marey.surface.points.checks import agreeing, continuous, in_large_pieces
from marey.surface.points.field import AROUND, Grid
from marey.surface.points.settings import MatchCheckSettings

GRID = Grid(left=10, top=12, spacing=2, rows=30, columns=40)
MAP = np.array([[1.02, 0.05], [-0.03, 0.97]])


EVERYWHERE = np.ones(len(GRID), bool)
MAPS = np.tile(MAP, (len(GRID), 1, 1))
SPREAD = np.full(len(GRID), 0.03)


def neighbours(grid):
    """The eight neighbours (n, 8) of each node; -1 beyond the border."""
    row, column = np.divmod(np.arange(len(grid)), grid.columns)
    r, c = row[:, None] + AROUND[:, 0], column[:, None] + AROUND[:, 1]
    inside = (r >= 0) & (r < grid.rows) & (c >= 0) & (c < grid.columns)
    return np.where(inside, r * grid.columns + c, -1)


def agreeing_by_formula(there, maps, found, grid, spread, settings):
    """Count neighbours and agreeing neighbours of all nodes at once."""
    beside = neighbours(grid)
    both = (beside >= 0) & found[beside] & found[:, None]
    step, apart = grid.pixels[beside] - grid.pixels[:, None], there[beside] - there[:, None]
    allowed = settings.tolerance_px + settings.spacing_ratio * grid.spacing
    allowed = allowed + settings.deviations * np.hypot(spread[beside], spread[:, None])
    fits = both.copy()
    for linear in (maps[:, None], maps[beside]):
        fits &= np.linalg.norm(apart - np.einsum("...ij,...j->...i", linear, step), axis=-1) <= allowed
    return both.sum(axis=1), fits.sum(axis=1)


def test_agreeing_neighbours_are_those_of_the_formula(rng):
    settings, found = MatchCheckSettings(), rng.random(len(GRID)) < 0.8
    there = GRID.pixels @ MAP.T + rng.normal(0, 0.2, (len(GRID), 2))
    maps, spread = MAPS + rng.normal(0, 0.05, MAPS.shape), rng.uniform(0.01, 0.1, len(GRID))
    there[~found], maps[~found], spread[~found] = np.nan, np.nan, np.inf
    counts = agreeing(there, maps, found, GRID, spread, settings)
    expected = agreeing_by_formula(there, maps, found, GRID, spread, settings)
    np.testing.assert_array_equal(counts, expected)
    assert 0 < expected[1].sum() < expected[0].sum()


def test_a_match_that_disagrees_with_all_neighbours_is_removed():
    there = GRID.pixels @ MAP.T + 3
    there[[200, 777]] += [1.5, 0]
    kept = continuous(there, MAPS, EVERYWHERE, GRID, SPREAD)
    assert not kept[[200, 777]].any()
    assert kept.sum() == len(GRID) - 2


def test_a_wider_tolerance_keeps_more():
    there = GRID.pixels @ MAP.T + 3
    there[[200, 777]] += [1.5, 0]
    wide = MatchCheckSettings(tolerance_px=2.0)
    assert continuous(there, MAPS, EVERYWHERE, GRID, SPREAD, wide).all()


def test_both_sides_of_a_step_in_depth_stay():
    there = GRID.pixels @ MAP.T
    there[GRID.pixels[:, 0] > 50] += [6, 0]
    assert continuous(there, MAPS, EVERYWHERE, GRID, SPREAD).mean() > 0.99


def test_noise_leaves_nothing(rng):
    there = GRID.pixels + rng.normal(0, 3, (len(GRID), 2))
    assert continuous(there, MAPS, EVERYWHERE, GRID, SPREAD).mean() < 0.02


def test_islands_are_sunk():
    found = np.zeros((GRID.rows, GRID.columns), bool)
    found[5:8, 5:8] = True
    found[15:27, 15:30] = True
    kept = in_large_pieces(found.ravel(), GRID).reshape(found.shape)
    assert not kept[5:8, 5:8].any()
    assert kept[15:27, 15:30].all()


def test_a_grid_covers_the_image_as_far_as_patches_fit():
    from marey.surface.points.views import SurfaceView

    camera = scenes.camera_at("a", 0)
    view = SurfaceView(camera=camera, image=np.zeros((camera.height, camera.width, 3), np.uint8))
    grid = Grid.over(view, spacing=7, half=6)
    low, high = grid.pixels.min(axis=0), grid.pixels.max(axis=0)
    assert (low >= 8).all()
    assert (low < 8 + 7).all()
    assert (high <= np.array(camera.size) - 9).all()
    np.testing.assert_array_equal(grid.nearest(grid.pixels + 2.5), np.arange(len(grid)))
