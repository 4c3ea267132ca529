"""Visual hulls of things whose hull is known."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.search.hull import (
    HullGrid,
    common_parts,
    filled,
    largest_part,
    meeting_point,
    room_between,
    visual_hull,
)

CELL = 0.04


def ball_masks(cameras, centre, radius):
    """A ball's silhouettes: the pixels whose rays pass its centre nearer than its radius."""
    masks = []
    for camera in cameras:
        y, x = np.mgrid[: camera.height, : camera.width]
        rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1).astype(float)).directions
        away = np.linalg.norm(np.cross(rays, centre - camera.centre), axis=1)
        masks.append((away <= radius).reshape(camera.height, camera.width))
    return masks


def test_the_hull_of_a_ball_contains_it_closely():
    cameras, centre, radius = worlds.ring(8), np.array([0.1, -0.05, 0.2]), 0.3
    hull = visual_hull(cameras, ball_masks(cameras, centre, radius), cell=CELL)
    distance = np.linalg.norm(hull - centre, axis=1)
    pixel = 3.2 / 300.0
    inside = 4 / 3 * np.pi * (radius - pixel) ** 3 / CELL**3
    assert (distance < radius - pixel).sum() == pytest.approx(inside, rel=0.05)
    # Eight views' cones about a ball meet no farther out than this over the widest gap between two of them.
    assert distance.max() < radius / np.cos(np.deg2rad(36)) + pixel


def test_every_cell_of_a_hull_lies_in_every_silhouette_that_has_it_in_view():
    cameras = worlds.ring(3)
    masks = ball_masks(cameras, np.zeros(3), 0.25)
    for cell in visual_hull(cameras, masks, cell=CELL):
        for camera, mask in zip(cameras, masks, strict=True):
            x, y = np.round(camera.project(cell)).astype(int)
            assert mask[y, x]


def test_a_persons_hull_contains_the_skeleton():
    cameras, body = worlds.ring(), worlds.person()
    posed = PosedBody(body, worlds.pose(body))
    hull = visual_hull(cameras, worlds.silhouettes(posed, cameras))
    away = np.linalg.norm(posed.segment_origin[:, None] - hull, axis=2).min(1)
    # A joint deep inside has a cell's centre within half a cell's diagonal; thin feet may fall between cells.
    assert np.sort(away)[:-4].max() <= 0.5 * np.sqrt(3) * 0.04
    assert away.max() < 0.08


def test_an_empty_silhouette_is_ignored_and_a_contradiction_gives_no_hull():
    cameras = worlds.ring()
    masks = ball_masks(cameras, np.zeros(3), 0.25)
    one_empty = [*masks[:3], np.zeros_like(masks[3])]
    np.testing.assert_array_equal(visual_hull(cameras, one_empty), visual_hull(cameras[:3], masks[:3]))
    assert visual_hull(cameras, [np.zeros_like(mask) for mask in masks]).shape == (0, 3)
    elsewhere = [*masks[:3], ball_masks(cameras[3:], np.array([0, 0, 0.6]), 0.1)[0]]
    assert len(visual_hull(cameras, elsewhere)) == 0


@pytest.mark.slow
def test_cells_in_view_of_one_camera_alone_are_not_filled():
    cameras = worlds.ring(2)
    masks = [np.ones((c.height, c.width), bool) for c in cameras]
    for cell in visual_hull(cameras, masks, cell=0.1):
        assert all(camera.sees(camera.project(cell[None]))[0] for camera in cameras)


def test_lines_of_sight_meet_where_the_ball_is():
    cameras, centre = worlds.ring(3), np.array([0.2, 0.1, -0.1])
    met = meeting_point(list(zip(cameras, ball_masks(cameras, centre, 0.1), strict=True)))
    np.testing.assert_allclose(met, centre, atol=0.5 * 3.2 / 300)


@pytest.mark.parametrize("witnesses", [1, 2, 3])
def test_the_filled_cells_are_those_of_the_plain_formula(rng, witnesses):
    cameras = worlds.ring(3, size=(160, 120), focal=500.0)
    masks = [rng.random((120, 160)) < 0.7 for _ in cameras]
    grid = HullGrid.about(np.array([0.02, 0.05, -0.03]), 0.9, 0.09)
    inside, seen = np.ones(grid.counts, bool), np.zeros(grid.counts, int)
    every = grid.centres(inside)
    for camera, mask in zip(cameras, masks, strict=True):
        pixels = camera.project(every)
        shown = camera.sees(pixels)
        column, row = np.floor(pixels[shown] + 0.5).astype(int).T
        hit = np.ones(len(every), bool)
        hit[shown] = mask[np.minimum(row, 119), np.minimum(column, 159)]
        inside &= hit.reshape(grid.counts)
        seen += shown.reshape(grid.counts)
    expected = inside & (seen >= witnesses)
    np.testing.assert_array_equal(filled(list(zip(cameras, masks, strict=True)), grid, witnesses=witnesses), expected)
    assert 0 < expected.sum() < expected.size


def test_the_common_parts_exclude_objects_of_a_single_camera():
    cameras, centre = worlds.ring(4), np.array([0.1, -0.05, 0.2])
    masks = ball_masks(cameras, centre, 0.3)
    cluttered = [mask.copy() for mask in masks]
    cluttered[1][:40] = True
    cluttered[2][:, -30:] = True
    for kept, mask in zip(common_parts(cameras, cluttered), masks, strict=True):
        assert np.count_nonzero(kept & mask) > 0.98 * np.count_nonzero(mask)
        # The cells are drawn a little larger than they are.
        assert np.count_nonzero(kept & ~mask) < 0.1 * np.count_nonzero(mask)


def test_the_larger_of_two_objects_is_kept():
    cameras = worlds.ring(4)
    large, small = (ball_masks(cameras, np.array([x, 0.0, 0.0]), r) for x, r in ((-0.35, 0.3), (0.45, 0.12)))
    kept = common_parts(cameras, [a | b for a, b in zip(large, small, strict=True)])
    left = [np.count_nonzero(part & ~mask) for part, mask in zip(kept, large, strict=True)]
    apart = [np.count_nonzero(other & ~mask) for other, mask in zip(small, large, strict=True)]
    # Where the small one stands right behind or before the large one no camera shows how far it extends.
    assert np.median(np.array(left) / np.maximum(apart, 1)) < 0.5
    for part, mask in zip(kept, large, strict=True):
        assert np.count_nonzero(part & mask) > 0.98 * np.count_nonzero(mask)


def test_silhouettes_without_a_common_part_become_empty():
    cameras = worlds.ring(3)
    masks = [np.zeros((camera.height, camera.width), bool) for camera in cameras]
    masks[0][:20], masks[1][-20:], masks[2][:20] = True, True, True
    assert not any(mask.any() for mask in common_parts(cameras, masks))


def test_a_single_silhouette_is_kept():
    cameras = worlds.ring(3)
    masks = [np.zeros((camera.height, camera.width), bool) for camera in cameras]
    masks[0][:20] = True
    for kept, mask in zip(common_parts(cameras, masks), masks, strict=True):
        np.testing.assert_array_equal(kept, mask)


def test_the_room_lies_between_cameras_that_look_at_its_middle():
    cameras = worlds.ring(5)
    point, reach = room_between(cameras)
    for camera in cameras:
        np.testing.assert_allclose(camera.project(point), (0.5 * (camera.width - 1), 0.5 * (camera.height - 1)), atol=2)
    assert reach == pytest.approx(0.8 * np.linalg.norm(cameras[0].centre - point), rel=0.01)


def test_the_largest_part_may_touch_at_corners():
    cells = np.zeros((5, 5, 5), bool)
    cells[0, 0, 0] = cells[1, 1, 1] = cells[2, 2, 2] = cells[4, 4, 0] = True
    assert largest_part(cells).sum() == 3
    assert not largest_part(np.zeros((3, 3, 3), bool)).any()
