from dataclasses import replace

import numpy as np
import pytest
from tests.moving_surface import three_cameras

from marey.surface.points.bend import bends
from marey.surface.points.field import Field, Grid
from marey.surface.tracks.uncertainty import PointsOfFrame, bends_of_tracks, stated_covariance

HALF, FLOOR = 6, 0.06


def points_of(rng, place, maps, *, cameras=None, noise=0.0):
    """Points whose pixels in the first view are given, with maps to the other two."""
    cameras = three_cameras() if cameras is None else cameras
    world = cameras[0].rays(place).directions * 1.5 + cameras[0].centre
    pixels = np.stack([camera.project(world) for camera in cameras], axis=1)
    pixels = pixels + rng.normal(0, noise, pixels.shape)
    return PointsOfFrame(
        position=world, covariance=np.tile(1e-8 * np.eye(3), (len(world), 1, 1)), pixels=pixels,
        sd=np.full(pixels.shape[:2], 0.02), template=np.zeros(len(world), np.int64),
        across=np.stack([np.tile(np.eye(2), (len(world), 1, 1)), maps, maps], axis=1),
    )  # fmt: skip


def curved_maps(place, slopes):
    """Affine maps that change linearly over the image, by slopes (2, 4) per pixel."""
    return np.eye(2) + ((place - place.mean(axis=0)) @ slopes).reshape(-1, 2, 2)


def test_the_bend_of_scattered_points_follows_from_the_slopes_of_their_maps(rng):
    place, slopes = rng.uniform(60, 120, (300, 2)), rng.normal(0, 1e-3, (2, 4))
    points = points_of(rng, place, curved_maps(place, slopes))
    found = bends_of_tracks(points, half=HALF, neighbours=24)
    expected = 0.5 * HALF * (HALF + 1) / 3 * np.array([slopes[0, 0] + slopes[1, 1], slopes[0, 2] + slopes[1, 3]])
    np.testing.assert_array_equal(found[:, 0], 0)
    np.testing.assert_allclose(found[:, 1:], np.broadcast_to(expected, (300, 2, 2)), atol=1e-5)


def test_the_bend_is_that_of_a_grid_of_matches(rng):
    grid = Grid(left=60, top=60, spacing=2, rows=21, columns=21)
    maps = curved_maps(grid.pixels, rng.normal(0, 1e-3, (2, 4)))
    dense = Field(
        there=grid.pixels, maps=maps, covariance=np.tile(1e-4 * np.eye(2), (len(grid), 1, 1)),
        correlation=np.full(len(grid), 0.9), size=np.full(len(grid), 2 * HALF + 1),
    )  # fmt: skip
    found = bends_of_tracks(points_of(rng, grid.pixels, maps), half=HALF, neighbours=24)
    np.testing.assert_allclose(found[:, 1], bends(dense, grid), atol=1e-5)


def test_points_alone_have_the_median_size_of_the_others_bend(rng):
    place = np.concatenate([rng.uniform(60, 100, (100, 2)), [[300.0, 200.0]]])
    slopes = np.array([[-2e-3, 0, 0, 0], [0, 0, 0, 0]])
    points = points_of(rng, place, curved_maps(place, slopes))
    found = bends_of_tracks(points, half=HALF, neighbours=24)
    assert found[0, 1, 0] == pytest.approx(-0.014, abs=1e-4)
    assert found[-1, 1, 0] == pytest.approx(0.014, abs=1e-4)


def test_a_view_that_does_not_show_a_point_has_no_bend(rng):
    place = rng.uniform(60, 100, (50, 2))
    points = points_of(rng, place, curved_maps(place, np.full((2, 4), 1e-3)))
    sd = points.sd.copy()
    sd[7, 2] = np.nan
    found = bends_of_tracks(replace(points, sd=sd), half=HALF, neighbours=24)
    assert np.argwhere(np.isnan(found[..., 0])).tolist() == [[7, 2]]


def test_residuals_and_bend_enlarge_the_covariance(rng):
    cameras, place = three_cameras(), rng.uniform(60, 120, (400, 2))
    flat = curved_maps(place, np.zeros((2, 4)))
    plain = points_of(rng, place, flat)
    np.testing.assert_allclose(stated_covariance(plain, cameras, floor_px=FLOOR, size=13), plain.covariance, atol=1e-20)
    # The noise is five times what the matches and the floor state.
    noisy = points_of(rng, place, flat, noise=5 * np.hypot(0.02, FLOOR))
    grown = stated_covariance(noisy, cameras, floor_px=FLOOR, size=13) / 1e-8
    assert 25 < grown[0, 0, 0] < 100
    bent = points_of(rng, place, curved_maps(place, np.array([[5e-3, 0, 0, 0], [0, 0, 0, 0]])))
    more = stated_covariance(bent, cameras, floor_px=FLOOR, size=13) - bent.covariance
    values = np.linalg.eigvalsh(more)
    # The bend acts in one direction: towards the cameras.
    assert np.all(values[:, 2] > 1e-8)
    assert np.all(np.abs(values[:, :2]) < 1e-6 * values[:, 2:])


def test_no_points_have_no_covariance(rng):
    nothing = points_of(rng, np.zeros((0, 2)), np.zeros((0, 2, 2)))
    assert stated_covariance(nothing, three_cameras(), floor_px=FLOOR, size=13).shape == (0, 3, 3)
