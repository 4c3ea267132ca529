"""Matching and moments in one kernel per camera are those of the separate steps."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.solver.matched_moments import match_moments
from marey.fit.solver.moments import gather_moments
from marey.fit.solver.normal_equations import normal_equations
from marey.fit.solver.pose_solver import match_all
from marey.fit.solver.threads import one_thread
from marey.images.silhouettes.interior import InteriorEdges
from marey.observations.correspondence import ObservedOutline, OutlineMatchSettings, view_of

SCALE = 4.0


@pytest.fixture(scope="module")
def scene():
    """A body near its silhouettes, which have edges inside, and the last of which is empty."""
    body, cameras = worlds.scan(), worlds.ring()
    truth = PosedBody(body, worlds.pose(body))
    level = SilhouetteLevel.at_size(cameras, worlds.silhouettes(truth, cameras))
    sightings = []
    for sighting in level.sightings:
        view = view_of(truth, sighting.camera)
        rim = view.interior_rim(body.faces, body.face_limb)
        edges = InteriorEdges(pixels=rim.pixels, inward=rim.inward, limb=body.face_limb[rim.face])
        sightings.append(replace(sighting, interior=edges))
    empty = ObservedOutline.of(cameras[0], np.zeros_like(level.masks[0]))
    near = truth.pose.step(np.full(len(body.skeleton), 0.02))
    return PosedBody(body, near), [*sightings, empty]


@pytest.mark.parametrize("interior", [False, True])
@pytest.mark.parametrize("vote", [False, True])
def test_the_equations_are_those_of_matches_that_are_summed_afterwards(scene, interior, vote):
    posed, sightings = scene
    matching = OutlineMatchSettings(gate=12.0, cosine=0.5, sigma_px=2.3, interior=interior, vote=vote)
    found, weights = match_all(posed, sightings, matching, SCALE)
    kinds = len(found)
    assert kinds > len(sightings) if interior else kinds == len(sightings) - 1
    expected = normal_equations(posed, gather_moments(posed, found, weights))
    summed = match_moments(posed, sightings, matching, SCALE)
    for own, other in zip(normal_equations(posed, summed.moments), expected, strict=True):
        np.testing.assert_allclose(own, other, atol=1e-9 * np.abs(other).max())
    assert summed.matches == sum(len(match.where) for match in found)
    assert summed.weight == pytest.approx(sum(own.sum() for own in weights))
    squares = [own @ match.residuals(posed)[:, 0] ** 2 for own, match in zip(weights, found, strict=True)]
    assert summed.square == pytest.approx(sum(squares))


def test_one_thread_gives_the_same_to_the_last_bit(scene):
    posed, sightings = scene
    summed = match_moments(posed, sightings, OutlineMatchSettings(interior=True), SCALE)
    with one_thread():
        alone = match_moments(posed, sightings, OutlineMatchSettings(interior=True), SCALE)
    np.testing.assert_array_equal(alone.moments.products, summed.moments.products)
    np.testing.assert_array_equal(alone.moments.linear, summed.moments.linear)
    assert alone[1:] == summed[1:]


def test_without_cameras_nothing_is_summed(scene):
    summed = match_moments(scene[0], [], OutlineMatchSettings(), SCALE)
    assert (summed.matches, summed.weight, summed.square) == (0, 0.0, 0.0)
    assert not summed.moments.products.any()
    assert not summed.moments.linear.any()


def test_pairs_of_segments_are_those_that_share_a_face(scene):
    body = scene[0].body
    pairs, numbers = body.segment_pairs
    shares = body.face_shares
    expected = {
        (int(k), int(j))
        for count, own in zip(shares.number, shares.segment, strict=True)
        for k in own[:count]
        for j in own[:count]
        if k <= j
    }
    assert {(int(k), int(j)) for k, j in pairs} == expected
    for number, (k, j) in enumerate(pairs):
        assert numbers[k, j] == number
    assert np.count_nonzero(numbers >= 0) == len(pairs)
