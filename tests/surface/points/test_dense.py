from dataclasses import replace

import numpy as np
import pytest
from tests import scenes
from tests.scenes import beside_ball

from marey.cameras.triangulate import triangulate
from marey.surface.points.clicked import clicked_seeds
from marey.surface.points.dense import match_tuples
from marey.surface.points.intersection import bend_displacements, intersect
from marey.surface.points.seeds import corners, find_seeds
from marey.surface.points.settings import SurfaceSettings
from marey.surface.points.views import TemplateSearch, views_of

SETTINGS = SurfaceSettings(spacing=4, seeds=200, enlarged=(1.6, 2.4))


def measured(rig, images, compared, masks=None, settings=SETTINGS):
    views = views_of(rig, images, masks)
    return intersect(views, match_tuples(views, compared, settings, threads=2), settings, frame=3)


@pytest.fixture(scope="module")
def triplet():
    return scenes.rig(-10, 0, 10), scenes.films(scenes.rig(-10, 0, 10), np.random.default_rng(5))


@pytest.fixture(scope="module")
def points(triplet):
    return measured(*triplet, TemplateSearch(1, (0, 2)))


@pytest.mark.slow
def test_points_lie_on_the_surface_and_cover_it(triplet, points):
    beside = np.abs(beside_ball(points.points))
    # Half a millimetre is a fifth of a pixel.
    assert np.median(beside) < 0.5e-3
    assert np.percentile(beside, 95) < 2e-3
    assert beside.max() < 10e-3
    visible = np.pi * (scenes.FOCAL * scenes.RADIUS / np.sqrt(scenes.DISTANCE**2 - scenes.RADIUS**2)) ** 2
    assert len(points) * SETTINGS.spacing**2 > 0.55 * visible
    assert (points.frame == 3).all()
    assert points.camera_names == ("left", "middle", "right")


def test_the_covariance_is_that_of_the_errors(points):
    outward = points.points / np.linalg.norm(points.points, axis=1, keepdims=True)
    sd = np.sqrt(np.einsum("ni,nij,nj->n", outward, points.covariance, outward))
    beside = np.abs(beside_ball(points.points)) / sd
    # Patches at the rim are displaced by the curvature of the ball; the covariance includes this.
    assert np.median(beside) / 0.6745 == pytest.approx(1, abs=0.2)
    assert np.mean(beside < 1.96) > 0.93


def test_all_views_are_drawn_aside_together(triplet, rng):
    rig, _ = triplet
    points = scenes.RADIUS * np.array([0, -1, 0]) + rng.normal(0, 0.02, (5, 3))
    pixels = np.stack([camera.project(points) for camera in rig], axis=1)
    bend, sigma = rng.normal(0, 0.01, pixels.shape), rng.uniform(0.05, 0.2, pixels.shape[:2])
    bend[0, 1] = np.nan
    moved = triangulate(list(rig), (pixels + bend).swapaxes(0, 1), sigma_px=sigma.T).points
    np.testing.assert_allclose(bend_displacements(list(rig), points, bend, sigma), moved - points, atol=2e-6)


def test_the_template_is_the_middle_and_its_patches_lie_on_the_grid(points):
    assert (points.template == 1).all()
    pixels = points.pixels[:, 1]
    np.testing.assert_array_equal(pixels, np.round(pixels))
    assert (points.views >= 2).all()
    assert np.nanmax(points.correlation[:, [0, 2]]) < 1
    assert np.median(points.residual_px) < 0.1


def test_two_cameras_suffice(triplet):
    rig, images = scenes.rig(-7, 7), None
    images = scenes.films(rig, np.random.default_rng(6))
    points = measured(rig, images, TemplateSearch(0, (1,)))
    assert len(points) > 300
    assert np.median(np.abs(beside_ball(points.points))) < 0.6e-3
    assert (points.views == 2).all()


def test_a_mask_keeps_the_rest_out(triplet, points):
    rig, images = triplet
    mask = np.zeros(images[0].shape[:2], bool)
    mask[:, :125] = True
    points = measured(rig, images, TemplateSearch(1, (0, 2)), masks=[None, mask, None])
    assert len(points) > 50
    assert points.pixels[:, 1, 0].max() < 125


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["flat", "blurred", "unrelated"])
def test_no_surface_is_made_up(rng, kind):
    rig = scenes.rig(-10, 0, 10)
    if kind == "flat":
        images = [scenes.Ball.draw(rng).flat().filmed(camera, rng) for camera in rig]
    elif kind == "blurred":
        images = scenes.films(rig, rng, shortest=0.6, longest=2.0)
    else:
        images = [scenes.Ball.draw(rng).filmed(camera, rng) for camera in rig]
    points = measured(rig, images, TemplateSearch(1, (0, 2)))
    assert len(points) < 10


def test_seeds_are_true_and_spread(triplet):
    rig, images = triplet
    views = views_of(rig, images)
    for seeds, other in zip(find_seeds(views[1], [views[0], views[2]], SETTINGS), (0, 2), strict=True):
        assert len(seeds) > 15
        ray = rig.cameras[1].rays(seeds.pixels).directions
        centre = rig.cameras[1].centre
        along = -ray @ centre
        place = centre + (along - np.sqrt(np.maximum(along**2 - centre @ centre + scenes.RADIUS**2, 0)))[:, None] * ray
        apart = np.linalg.norm(rig.cameras[other].project(place) - seeds.there, axis=1)
        # At the rim, patches also contain the background.
        assert np.median(apart) < 0.2
        assert np.percentile(apart, 90) < 1.0
        assert np.ptp(seeds.pixels, axis=0).min() > 80


def test_corners_come_from_all_over_the_image(triplet):
    rig, images = triplet
    view = views_of(rig, images)[1]
    found = corners(view, most=100)
    assert 20 < len(found) <= 100
    gaps = np.linalg.norm(found[:, None] - found[None], axis=-1)[np.triu_indices(len(found), 1)]
    assert np.median(np.sort(gaps)[: len(found)]) > 4


def test_the_settings_of_the_search_reach_the_seeds(triplet):
    rig, images = triplet
    views = views_of(rig, images)
    strict = replace(SETTINGS, seed_search=replace(SETTINGS.seed_search, correlation=1.1))
    assert [len(seeds) for seeds in find_seeds(views[1], [views[0], views[2]], strict)] == [0, 0]


def test_clicks_are_moved_to_the_true_position_and_wrong_ones_are_reported(triplet, rng):
    rig, images = triplet
    views, compared = views_of(rig, images), (TemplateSearch(1, (0, 2)),)
    ahead = rig.cameras[1].centre / np.linalg.norm(rig.cameras[1].centre)
    places = scenes.RADIUS * np.array([ahead + 0.2 * rng.normal(0, 1, 3) for _ in range(4)])
    places *= scenes.RADIUS / np.linalg.norm(places, axis=1, keepdims=True)
    clicks = np.stack([camera.project(places) for camera in rig], axis=1)
    clicks += rng.uniform(-2, 2, clicks.shape)
    clicks[1, 2] = np.nan
    clicks[3, 0] += [60, 0]
    clicks[3, 1] -= [60, 0]
    found, confirmed = clicked_seeds(views, compared, clicks, SETTINGS)
    assert confirmed.tolist() == [True, True, True, False]
    for seeds in found.values():
        assert len(seeds) == 3


def test_points_further_apart_are_found_by_half_steps(triplet):
    rig, images = triplet
    few = measured(rig, images, TemplateSearch(1, (0, 2)), settings=SurfaceSettings(spacing=10, seeds=200))
    assert len(few) > 40
    assert np.median(np.abs(beside_ball(few.points))) < 0.6e-3
