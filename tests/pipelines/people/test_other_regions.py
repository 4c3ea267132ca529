"""Regions of other people in an image: in front or behind, refined by colours, and the colours learned from them."""

import numpy as np
import pytest
from tests import worlds
from tests.detected import JOINTS, joints

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.person_figures import PersonFigure
from marey.images.silhouettes.densities import colour_density
from marey.images.silhouettes.part_colours import PartColours
from marey.pipelines.people.other_regions import CapturedPerson, OtherColourSums, OtherFigures, PosedPerson, widened

[CAMERA, *_] = worlds.ring(1, size=(320, 240))
OTHER, FOLLOWED = (40, 90, 200), (190, 120, 40)


@pytest.fixture
def two():
    """Two people, the other one 1 m nearer to the camera, and an image of them."""
    body = worlds.person()
    towards = CAMERA.centre / np.linalg.norm(CAMERA.centre)
    aside = np.array([-towards[1], towards[0], 0.0])
    near = PosedBody(body, worlds.pose(body, at=1.0 * towards * [1, 1, 0] + 0.15 * aside))
    far = PosedBody(body, worlds.pose(body))
    figure = PersonFigure(
        CAMERA.project(joints(near)), float(np.linalg.norm(near.segment_origin.mean(0) - CAMERA.centre))
    )
    others = OtherFigures(JOINTS, {(7, 0): [figure]}, [CAMERA.width])
    [front], [behind] = worlds.silhouettes(near, [CAMERA]), worlds.silhouettes(far, [CAMERA])
    image = np.full((240, 320, 3), 120.0)
    image[behind], image[front] = FOLLOWED, OTHER
    image = np.clip(image + np.random.default_rng(1).normal(size=image.shape) * 4, 0, 255).astype(np.uint8)
    return others, near, far, front, behind, image


def test_whoever_is_nearer_is_in_front(two):
    others, near, far, *_ = two
    seen = others.regions(7, 0, CAMERA, far.segment_origin.mean(0))
    assert seen is not None
    assert seen.front.any()
    assert not seen.behind.any()
    other_way = others.regions(
        7, 0, CAMERA, near.segment_origin.mean(0) + 0.5 * (CAMERA.centre - far.segment_origin[0])
    )
    assert other_way is not None
    assert other_way.behind.any()
    assert not other_way.front.any()


def test_a_figure_is_at_its_place_in_a_reduced_image(two):
    others, _, far, front, *_ = two
    seen = others.regions(7, 0, CAMERA.scaled(0.5), far.segment_origin.mean(0))
    assert seen is not None
    assert seen.front.shape == (CAMERA.height // 2, CAMERA.width // 2)
    small = front.reshape(*seen.front.shape[:1], 2, -1, 2).all((1, 3))
    # As in the full image, the figure covers most of the body.
    full = others.regions(7, 0, CAMERA, far.segment_origin.mean(0)).front
    share = np.count_nonzero(full & front) / np.count_nonzero(front)
    assert share > 0.5
    assert abs(np.count_nonzero(seen.front & small) / np.count_nonzero(small) - share) < 0.1


def test_images_without_other_people_have_no_region(two):
    others, _, far, *_ = two
    assert others.regions(6, 0, CAMERA, far.segment_origin.mean(0)) is None
    assert others.regions(7, 1, CAMERA, far.segment_origin.mean(0)) is None


def test_colours_make_the_region_exact(two):
    others, _, far, front, behind, image = two
    seen = others.regions(7, 0, CAMERA, far.segment_origin.mean(0))
    sums = OtherColourSums(2)
    sums.add(0, image, seen, behind)
    followed = PartColours(colour_density(image, behind & ~front)[None])
    learned, missing = sums.learned([followed, followed])
    assert missing is None
    assert float(learned.others.sum()) * 8**3 == pytest.approx(1.0, abs=0.02)
    rough = np.count_nonzero(seen.front & front) / np.count_nonzero(seen.front | front)
    refined = seen.refined(image, learned, behind)
    fine = np.count_nonzero(refined.front & front) / np.count_nonzero(refined.front | front)
    assert fine > max(0.9, rough)
    assert (refined.near >= refined.front).all()


def test_a_region_is_widened_by_a_distance():
    mask = np.zeros((20, 20), bool)
    assert not widened(mask, 3).any()
    mask[10, 10] = True
    grown = widened(mask, 3)
    assert grown[10, 13]
    assert not grown[10, 14]


def test_a_posed_person_is_where_its_captured_skin_is(two):
    _, near, far, front, *_ = two
    posed = PosedPerson(near.body, {7: near.pose}, 0.05)
    captured = CapturedPerson(np.stack([np.full_like(near.vertices, np.nan), near.vertices]), near.body.faces)
    place = far.segment_origin.mean(0)
    assert posed.regions(6, 0, CAMERA, place) is None
    assert captured.regions(0, 0, CAMERA, place) is None
    own, skin = posed.regions(7, 0, CAMERA, place), captured.regions(1, 0, CAMERA, place)
    assert own is not None
    assert skin is not None
    assert not own.behind.any()
    np.testing.assert_array_equal(own.front, skin.front)
    assert np.count_nonzero(own.front ^ front) < 0.02 * np.count_nonzero(front)
    away = float(np.linalg.norm(near.vertices.mean(axis=0) - CAMERA.centre))
    assert own.sd_px == pytest.approx(0.05 * CAMERA.matrix[0, 0] / away)
