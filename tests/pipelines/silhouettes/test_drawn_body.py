"""The parts of a drawn body, and the prior of its silhouette."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.observations.correspondence import view_of
from marey.pipelines.silhouettes.drawn_body import STEEPNESS, STRONGEST, outline_prior, part_map


@pytest.fixture(scope="module")
def posed():
    body = worlds.person()
    return PosedBody(body, worlds.pose(body))


def bars():
    """Two parts beside each other: columns 30 to 49 and 50 to 69."""
    parts = np.full((60, 100), -1)
    parts[10:50, 30:50], parts[10:50, 50:70] = 0, 1
    return parts


def test_the_slope_of_the_prior_is_that_of_the_nearest_part():
    deviations = np.array([4.0, 10.0])
    prior = outline_prior(bars(), deviations)
    # Along the middle row: distances are counted from the centre of the nearest pixel on the other side. OpenCV counts
    # a step along a row as 0.955 px, which makes the mean error over all directions smallest.
    row, x = prior[30], np.arange(100)
    for part, outside, inside in ((0, x[22:30], x[30:38]), (1, x[70:84], x[62:70])):
        edge = 30 if part == 0 else 69
        away = np.abs(outside - edge)
        np.testing.assert_allclose(row[outside], -away * STEEPNESS / deviations[part], rtol=0.05)
        depth = np.abs(inside - edge) + 1
        np.testing.assert_allclose(row[inside], depth * STEEPNESS / deviations[part], rtol=0.05)


def test_the_prior_is_clipped():
    prior = outline_prior(bars(), np.array([0.5, 0.5]))
    assert prior.max() == pytest.approx(STRONGEST)
    assert prior.min() == pytest.approx(-STRONGEST)
    assert prior[30, 0] == prior[0, 50] == -STRONGEST
    np.testing.assert_array_equal(prior > 0, bars() >= 0)


def test_a_larger_uncertainty_gives_a_weaker_prior(posed):
    parts = part_map(posed, worlds.ring(1)[0])
    sure, unsure = (outline_prior(parts, np.full(len(COLOUR_PARTS), sd)) for sd in (3.0, 9.0))
    weak = np.abs(sure) < STRONGEST
    np.testing.assert_allclose(sure[weak], 3 * unsure[weak], rtol=1e-5)


def test_the_map_of_parts_is_the_drawn_body(posed):
    camera = worlds.ring(1)[0]
    parts = part_map(posed, camera)
    np.testing.assert_array_equal(parts >= 0, view_of(posed, camera).mask())
    # At the image of its centre a segment is drawn, unless another one is in front.
    skeleton = posed.body.skeleton
    for name, part in (("head", "head"), ("left_shank", "shank"), ("left_forearm", "forearm")):
        own = np.isin(posed.body.face_segment, skeleton.segment(name))
        x, y = camera.project(posed.vertices[posed.body.faces[own]].mean((0, 1))[None])[0].round().astype(int)
        assert COLOUR_PARTS[parts[y, x]] == part
