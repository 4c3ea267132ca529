"""Visual hulls of things whose hull is known."""

import numpy as np
import pytest
from tests import worlds

from marey.body.pose import PosedBody
from marey.fit.hull import meeting_point, visual_hull

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


def test_the_hull_of_a_ball_holds_it_and_little_else():
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


def test_a_persons_hull_holds_the_skeleton():
    cameras, body = worlds.ring(), worlds.person()
    posed = PosedBody(body, worlds.pose(body))
    hull = visual_hull(cameras, worlds.silhouettes(posed, cameras))
    away = np.linalg.norm(posed.segment_origin[:, None] - hull, axis=2).min(1)
    # A joint deep inside has a cell's centre within half a cell's diagonal; thin feet may fall between cells.
    assert np.sort(away)[:-4].max() <= 0.5 * np.sqrt(3) * 0.04
    assert away.max() < 0.08


def test_an_empty_silhouette_says_nothing_and_a_contradiction_leaves_nothing():
    cameras = worlds.ring()
    masks = ball_masks(cameras, np.zeros(3), 0.25)
    nobody = [*masks[:3], np.zeros_like(masks[3])]
    np.testing.assert_array_equal(visual_hull(cameras, nobody), visual_hull(cameras[:3], masks[:3]))
    assert visual_hull(cameras, [np.zeros_like(mask) for mask in masks]).shape == (0, 3)
    elsewhere = [*masks[:3], ball_masks(cameras[3:], np.array([0, 0, 0.6]), 0.1)[0]]
    assert len(visual_hull(cameras, elsewhere)) == 0


def test_what_one_camera_alone_has_in_view_is_not_filled():
    cameras = worlds.ring(2)
    masks = [np.ones((c.height, c.width), bool) for c in cameras]
    for cell in visual_hull(cameras, masks, cell=0.1):
        assert all(camera.sees(camera.project(cell[None]))[0] for camera in cameras)


def test_lines_of_sight_meet_where_the_ball_is():
    cameras, centre = worlds.ring(3), np.array([0.2, 0.1, -0.1])
    met = meeting_point(list(zip(cameras, ball_masks(cameras, centre, 0.1), strict=True)))
    np.testing.assert_allclose(met, centre, atol=0.5 * 3.2 / 300)
