"""Pixels as equations of points, compared with a direct computation and finite differences."""

import numpy as np
import pytest
from tests.nonrigid.made_shapes import three_cameras

from marey.geometry import rotations
from marey.nonrigid.in_space.measured_places import PointsInSpace, departures
from marey.nonrigid.in_space.pixel_places import FAR, PixelPlaces

FRAMES, POINTS = 6, 5


@pytest.fixture
def rig():
    return three_cameras()


@pytest.fixture
def points(rng):
    return 0.2 * rng.normal(size=(FRAMES, POINTS, 3))


@pytest.fixture
def pixels(rig, points, rng):
    """(C, F, P, 2) with noise of half a pixel; one point is seen by one camera, one by none."""
    seen = np.stack([camera.project(points) for camera in rig]) + 0.5 * rng.normal(size=(3, FRAMES, POINTS, 2))
    seen[1:, 2, 3], seen[:, 4, 1] = np.nan, np.nan
    return seen


def plainly(rig, pixels, model, variance, sigma):
    """The equations of one place, as sums over the cameras."""
    normal, pull = np.zeros((3, 3)), np.zeros(3)
    for camera, seen in zip(rig, pixels, strict=True):
        if np.isnan(seen).any():
            continue
        slope = np.stack([(camera.project(model + d) - camera.project(model - d)) / 2e-6 for d in 1e-6 * np.eye(3)], 1)
        residual = seen - camera.project(model)
        expected = sigma**2 + variance * np.sum(slope**2) / 2
        weight = min(1.0, FAR / (residual @ residual / expected)) / sigma**2
        normal, pull = normal + weight * slope.T @ slope, pull + weight * slope.T @ residual
    mixed = np.linalg.inv(np.eye(3) + variance * normal)
    return mixed @ normal, mixed @ pull


def test_the_equations_are_sums_over_the_cameras_with_the_variance_about_the_model(rig, points, pixels, rng):
    pixels[0, 0, 0] += 40  # an outlier
    model, variance = points + 0.003 * rng.normal(size=points.shape), 1e-5
    information, pull = PixelPlaces(rig.cameras, pixels, np.full(pixels.shape[:3], 0.5)).equations(model, variance)
    for frame in range(FRAMES):
        for point in range(POINTS):
            expected = plainly(rig, pixels[:, frame, point], model[frame, point], variance, 0.5)
            np.testing.assert_allclose(information[frame, point], expected[0], rtol=1e-5, atol=1e-5 / variance)
            np.testing.assert_allclose(pull[frame, point], expected[1], rtol=1e-4, atol=1e-3)


def test_known_positions_and_their_accuracy(rig, points, pixels):
    places = PixelPlaces(rig.cameras, pixels, np.full(pixels.shape[:3], 0.5))
    assert not places.seen[4, 1]
    assert places.seen[2, 3]
    assert np.isnan(places.known[2, 3]).all()
    assert places.coordinates == 3 * (FRAMES * POINTS - 2) + 2
    wrong = ((places.known - points) ** 2).sum(-1) / places.known_variance
    assert np.nanmean(wrong) == pytest.approx(1, abs=0.5)
    hidden = np.zeros(places.seen.shape, bool)
    hidden[1, 1] = True
    assert not places.without(hidden).seen[1, 1]
    assert places.among(np.arange(FRAMES) < 4, np.arange(POINTS) > 1).seen.shape == (4, 3)
    assert np.isnan(places.squares(points)[4, 1])
    assert np.nanmean(places.squares(points)) == pytest.approx(2 * 0.5**2, rel=0.4)


def test_departures_of_points_are_exact_and_those_of_pixels_are_not(rig, points, pixels):
    away, unsure = departures(PointsInSpace(points), points - 0.01, 1e-4)
    np.testing.assert_allclose(away, 0.01)
    np.testing.assert_allclose(unsure, 0, atol=1e-15)
    _, unsure = departures(PixelPlaces(rig.cameras, pixels, np.full(pixels.shape[:3], 0.5)), points, 1e-4)
    assert unsure[4, 1] == 0
    # one ray leaves the depth to the spread about the model
    assert unsure[2, 3] == pytest.approx(1e-4, rel=0.1)
    assert 0 < unsure[0, 0] < 1e-5


def test_points_of_one_camera_and_frames_without_pose_are_initialised(rig, rng):
    mean = 0.2 * rng.normal(size=(6, 3))
    rotation = rotations.exp(np.linspace(0, 0.8, 20)[:, None] * [0.0, 0.0, 1.0])
    points = np.einsum("fij,pj->fpi", rotation, mean)
    pixels = np.stack([camera.project(points) for camera in rig])
    pixels[1:, :, 5] = np.nan
    given = np.where(np.arange(6)[:, None] == 5, np.nan, mean)
    poses = np.where(np.arange(20)[:, None, None] == 7, np.nan, rotation)
    places = PixelPlaces(rig.cameras, pixels, np.full(pixels.shape[:3], 0.5))
    found, begun, _ = places.placed(given, poses, np.zeros((20, 3)))
    np.testing.assert_allclose(found, mean, atol=1e-6)
    np.testing.assert_allclose(begun[7], rotation[7], atol=1e-6)
