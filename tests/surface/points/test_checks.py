import numpy as np
from tests import scenes

from marey.surface.points.checks import continuous, in_large_pieces
from marey.surface.points.field import Field, Grid
from marey.surface.points.settings import MatchCheckSettings

GRID = Grid(left=10, top=12, spacing=2, rows=30, columns=40)
MAP = np.array([[1.02, 0.05], [-0.03, 0.97]])


def field(there, found=None):
    count = len(GRID)
    found = np.ones(count, bool) if found is None else found
    whole = Field(
        there=there, maps=np.tile(MAP, (count, 1, 1)), covariance=np.tile(1e-3 * np.eye(2), (count, 1, 1)),
        correlation=np.full(count, 0.95), size=np.full(count, 13),
    )  # fmt: skip
    return whole.only(found)


def test_a_match_that_disagrees_with_all_neighbours_is_removed():
    there = GRID.pixels @ MAP.T + 3
    there[[200, 777]] += [1.5, 0]
    kept = continuous(field(there), GRID, np.full(len(GRID), 0.03)).found
    assert not kept[[200, 777]].any()
    assert kept.sum() == len(GRID) - 2


def test_a_wider_tolerance_keeps_more():
    there = GRID.pixels @ MAP.T + 3
    there[[200, 777]] += [1.5, 0]
    wide = MatchCheckSettings(tolerance_px=2.0)
    assert continuous(field(there), GRID, np.full(len(GRID), 0.03), wide).found.all()


def test_both_sides_of_a_step_in_depth_stay():
    there = GRID.pixels @ MAP.T
    there[GRID.pixels[:, 0] > 50] += [6, 0]
    kept = continuous(field(there), GRID, np.full(len(GRID), 0.03)).found
    assert kept.mean() > 0.99


def test_noise_leaves_nothing(rng):
    there = GRID.pixels + rng.normal(0, 3, (len(GRID), 2))
    assert continuous(field(there), GRID, np.full(len(GRID), 0.03)).found.mean() < 0.02


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
    assert (grid.neighbours(np.array([0])) >= 0).sum() == 3
    np.testing.assert_array_equal(grid.nearest(grid.pixels + 2.5), np.arange(len(grid)))
