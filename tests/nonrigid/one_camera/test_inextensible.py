"""Depths from constant distances between neighbours: a bent sheet, lost tracks, gaps."""

import numpy as np
import pytest

from marey.nonrigid.one_camera.inextensible import inextensible_depths, neighbours

FRAMES = 12


def rolled(curvature):
    """Give a sheet (3, 42) of 0.6 by 0.5 rolled about a slanted axis, two sizes before the camera."""
    u, v = (side.ravel() for side in np.meshgrid(np.linspace(-0.3, 0.3, 7), np.linspace(-0.25, 0.25, 6)))
    across, beside = 0.8 * u + 0.6 * v, 0.8 * v - 0.6 * u
    x = np.sin(curvature * across) / curvature
    z = (1 - np.cos(curvature * across)) / curvature
    return np.stack([0.8 * x - 0.6 * beside, 0.6 * x + 0.8 * beside, z + 1.2])


@pytest.fixture(scope="module")
def sheet():
    """Points (F, 3, P) of a sheet that is rolled one way, then the other."""
    return np.stack([rolled(c) for c in np.linspace(-3.3, 3.5, FRAMES)])


def rays_of(points):
    return points / points[:, 2:]


def depth_error(depth, points):
    """Give the median error of depths (F, P) after one common scale, as a share of the depth."""
    scale = np.nansum(depth * points[:, 2]) / np.nansum(depth**2)
    return np.nanmedian(np.abs(scale * depth - points[:, 2]) / points[:, 2])


def test_a_bent_sheet_is_found_with_its_sign_of_depth(sheet):
    rays, seen = rays_of(sheet), np.ones((FRAMES, sheet.shape[2]), bool)
    pairs = neighbours(rays[:, :2], seen, 8)
    depth, distance = inextensible_depths(rays, seen, pairs)
    assert depth_error(depth, sheet) < 0.01
    assert distance.mean() == pytest.approx(1)
    lengths = np.linalg.norm(sheet[:, :, pairs[:, 0]] - sheet[:, :, pairs[:, 1]], axis=1).mean(0)
    np.testing.assert_allclose(distance, lengths / lengths.mean(), rtol=0.1)


def test_points_that_are_not_seen_have_no_depth_and_no_effect(sheet, rng):
    seen = rng.random((FRAMES, sheet.shape[2])) > 0.15
    rays = np.where(seen[:, None], rays_of(sheet), 7.0)
    depth = inextensible_depths(rays, seen, neighbours(rays[:, :2], seen, 8))[0]
    assert np.isnan(depth[~seen]).all()
    assert depth_error(depth, sheet) < 0.015


def test_one_lost_track_does_not_affect_others(sheet):
    rays, seen = rays_of(sheet), np.ones((FRAMES, sheet.shape[2]), bool)
    rays[3, :2, 20] += 0.15
    depth = inextensible_depths(rays, seen, neighbours(rays[:, :2], seen, 8))[0]
    others = np.arange(sheet.shape[2]) != 20
    assert depth_error(depth[:, others], sheet[:, :, others]) < 0.015


def test_points_seen_apart_from_all_others_have_no_depth(sheet):
    rays, seen = rays_of(sheet), np.ones((FRAMES, sheet.shape[2]), bool)
    pairs = neighbours(rays[:, :2], seen, 8)
    seen[5] = np.arange(sheet.shape[2]) % 7 < 3
    seen[5, [6, 13]] = True
    # The two are seen one behind the other: their distance would be kept at any depth.
    rays[5, :, 13] = rays[5, :, 6] + np.array([1e-4, 0, 0])
    depth = inextensible_depths(rays, seen, pairs)[0]
    assert np.isnan(depth[5, [6, 13]]).all()
    assert np.nanmax(depth) < 2 * np.nanmedian(depth)
    assert np.isfinite(depth[5]).sum() == 18


@pytest.mark.slow
def test_two_unconnected_objects_both_have_depths(sheet):
    both = np.concatenate([sheet, sheet + np.array([3.0, 0, 0])[:, None]], 2)
    rays, seen = rays_of(both), np.ones((FRAMES, both.shape[2]), bool)
    seen[4, :5] = False
    depth = inextensible_depths(rays, seen, neighbours(rays[:, :2], seen, 8))[0]
    np.testing.assert_array_equal(np.isfinite(depth), seen)


def test_neighbours_are_near_in_every_frame_and_listed_once():
    place = np.array([[0.0, 1, 2.2, 3.5], [0, 0, 0, 0]])
    tracks = np.stack([place, place, place])
    assert neighbours(tracks, np.ones((3, 4), bool), 1).tolist() == [[0, 1], [1, 2], [2, 3]]
    tracks[1:, 0, 1] += 50
    assert neighbours(tracks, np.ones((3, 4), bool), 1).tolist() == [[0, 2], [1, 3], [2, 3]]
