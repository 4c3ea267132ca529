import numpy as np
import pytest
from tests import scenes

from marey.cameras.epipolar import epipolar_lines
from marey.surface.points.sweep import correlations, facing_maps, hypotheses

CAMERAS = scenes.rig(-7, 7).cameras


@pytest.fixture
def pixels(rng):
    return rng.uniform(60, 180, (12, 2))


def points_before(pixels, depth):
    return CAMERAS[0].centre + depth * CAMERAS[0].rays(pixels).directions


def test_a_map_is_the_derivative_by_way_of_a_plane_that_faces_both_cameras(pixels):
    points = points_before(pixels, 0.8)
    places, maps = facing_maps(*CAMERAS, pixels, points)
    np.testing.assert_allclose(places, CAMERAS[1].project(points), atol=1e-9)
    normal = CAMERAS[0].centre - points
    other = CAMERAS[1].centre - points
    normal = normal / np.linalg.norm(normal, axis=1)[:, None] + other / np.linalg.norm(other, axis=1)[:, None]
    for k, step in enumerate(np.eye(2)):
        rays = CAMERAS[0].rays(pixels + 0.5 * step).directions, CAMERAS[0].rays(pixels - 0.5 * step).directions
        there = []
        for ray in rays:
            depth = np.sum(normal * (points - CAMERAS[0].centre), 1) / np.sum(normal * ray, 1)
            there.append(CAMERAS[1].project(CAMERAS[0].centre + depth[:, None] * ray))
        np.testing.assert_allclose(maps[:, :, k], there[0] - there[1], atol=1e-9)


def test_hypotheses_lie_on_the_epipolar_line_a_step_apart_and_inside_the_image(pixels):
    tried = hypotheses(*CAMERAS, pixels, step=1.5, margin=8)
    for i, (a, b) in enumerate(zip(tried.first[:-1], tried.first[1:], strict=True)):
        places = tried.places[a:b]
        on_line, _ = epipolar_lines(*CAMERAS, np.repeat(pixels[i : i + 1], b - a, 0), places)
        # Between the depths at which the curve is computed it is straight.
        assert np.linalg.norm(on_line - places, axis=1).max() < 0.05
        assert CAMERAS[1].sees(places, margin=7.5).all()
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        assert steps.max() < 1.6
        truth = CAMERAS[1].project(points_before(pixels[i : i + 1], 0.8))[0]
        assert np.linalg.norm(places - truth, axis=1).min() < 0.8


def test_the_true_depth_correlates_best(rng):
    images = [image[..., 0].astype(np.float32) for image in scenes.films(scenes.rig(-7, 7), rng, noise=0.5)]
    pixels = rng.uniform(100, 150, (20, 2))
    tried = hypotheses(*CAMERAS, pixels, step=1.0, margin=8)
    scores = correlations(*images, pixels, tried, half=8)
    assert scores.min() >= -1
    assert scores.max() <= 1 + 1e-5
    for i, (a, b) in enumerate(zip(tried.first[:-1], tried.first[1:], strict=True)):
        ray = CAMERAS[0].rays(pixels[i]).directions
        along = -ray @ CAMERAS[0].centre
        depth = along - np.sqrt(along**2 - CAMERAS[0].centre @ CAMERAS[0].centre + scenes.RADIUS**2)
        truth = CAMERAS[1].project(CAMERAS[0].centre + depth * ray)
        assert np.linalg.norm(tried.places[a + scores[a:b].argmax()] - truth) < 1.0


def test_a_pixel_whose_line_misses_the_image_has_no_hypothesis():
    cameras = scenes.camera_at("a", 0), scenes.camera_at("b", 120)
    tried = hypotheses(*cameras, np.array([[2.0, 120.0]]), step=1.0, margin=8)
    assert tried.first[-1] == len(tried.places)


def test_a_part_of_the_hypotheses_belongs_to_the_same_pixels(pixels, rng):
    tried = hypotheses(*CAMERAS, pixels, step=1.5, margin=8)
    kept = rng.random(len(tried.places)) < 0.3
    kept[tried.first[3] : tried.first[4]] = False
    part = tried.only(kept)
    for i, (a, b) in enumerate(zip(tried.first[:-1], tried.first[1:], strict=True)):
        own = slice(part.first[i], part.first[i + 1])
        np.testing.assert_array_equal(part.places[own], tried.places[a:b][kept[a:b]])
        np.testing.assert_array_equal(part.maps[own], tried.maps[a:b][kept[a:b]])
    assert part.first[3] == part.first[4]
