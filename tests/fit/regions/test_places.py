"""The place of an upright person in a room, from the words that the cameras have in common there."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.regions import WORDS, painted

from marey.body.articulation.pose import Pose, PosedBody
from marey.fit.regions.places import PlaceSettings, best_height, find_places, places_in_view, postures_of
from marey.fit.regions.region_search import RegionSearch, thinned
from marey.geometry import rotations

SETTINGS = PlaceSettings(step=0.3, coarse_step=0.6, height_step=0.4, below=1.2, postures=(0, 8), headings=2)
FLOOR = -1.0
"""Height of the floor [m]: the cameras look at the world's origin, where a pelvis may be."""


@pytest.fixture(scope="module")
def search():
    return RegionSearch(tuple(worlds.ring(size=(80, 60), focal=60.0)), WORDS)


def standing(body, at, heading=0.0) -> Pose:
    postures, heights = postures_of(body)
    turn = rotations.about(np.array([0.0, 0.0, 1.0]), heading)
    return Pose(np.array([*at, FLOOR + heights[0]]), turn, postures[0])


@pytest.mark.slow
def test_a_person_is_found_in_each_frame_of_a_walk(search, rng):
    body = thinned(worlds.person())
    places = [(-0.5, 0.3), (0.0, 0.3), (0.5, 0.2)]
    images = [painted(PosedBody(body, standing(body, place)), search.cameras, rng) for place in places]
    found = find_places(search, body, images, [0.0, 0.5, 1.0], SETTINGS)
    assert found is not None
    for pose, place in zip(found, places, strict=True):
        # Half the diagonal of a cell. Few headings and postures are tried, so that the height is less certain.
        assert np.linalg.norm(pose.translation[:2] - place) <= 0.5 * np.sqrt(2) * SETTINGS.step + 1e-9
        assert abs(pose.translation[2] - standing(body, place).translation[2]) <= SETTINGS.height_step


@pytest.mark.slow
def test_a_place_that_nobody_can_reach_in_time_is_not_chosen(search, rng):
    body = thinned(worlds.person())
    here, there = (-0.6, 0.0), (0.6, 0.0)
    shown = [here, here, there, here]
    images = [painted(PosedBody(body, standing(body, place)), search.cameras, rng) for place in shown]
    slow = replace(SETTINGS, speed=0.5, slack=0.1)
    found = find_places(search, body, images, [0.0, 0.1, 0.2, 0.3], slow)
    assert found is not None
    assert all(np.linalg.norm(pose.translation[:2] - here) < 0.5 for pose in found)


def test_without_a_place_in_view_of_two_cameras_nobody_is_found(search, rng):
    body = thinned(worlds.person())
    alone = RegionSearch(search.cameras[:1], WORDS)
    images = painted(PosedBody(body, standing(body, (0, 0))), alone.cameras, rng)
    assert find_places(alone, body, [images], [0.0], SETTINGS) is None
    assert len(places_in_view(alone.cameras, SETTINGS, step=0.5, floor=FLOOR)) == 0


def test_the_places_form_a_grid_whose_bodies_two_cameras_see(search):
    places = places_in_view(search.cameras, SETTINGS, step=0.5, floor=FLOOR)
    assert len(places) > 4
    for place in places:
        seen = [camera.sees(camera.project(np.array([[*place, FLOOR + 1.0]])))[0] for camera in search.cameras]
        assert sum(seen) >= 2


def test_people_who_are_cut_by_the_border_have_more_places(search):
    whole = places_in_view(search.cameras, SETTINGS, step=0.5, floor=FLOOR)
    part = places_in_view(search.cameras, replace(SETTINGS, in_view=4), step=0.5, floor=FLOOR)
    assert len(part) > len(whole)
    assert {tuple(place) for place in whole} <= {tuple(place) for place in part}


def test_a_known_floor_is_not_searched(search, rng):
    body = thinned(worlds.person())
    images = [painted(PosedBody(body, standing(body, (0.3, 0.0))), search.cameras, rng)]
    for height in (0.0, 0.15):
        (pose,) = find_places(search, body, images, [0.0], SETTINGS, FLOOR + height) or []
        lowest = PosedBody(body, pose).vertices[:, 2].min()
        assert lowest == pytest.approx(FLOOR + height, abs=1e-6)


def test_the_floor_is_not_judged_by_frames_that_show_nobody():
    # Three frames agree best with the middle height; the first one is empty, and its scores favour the lowest.
    scores = {0.2: [-2.0, 1.6, 1.5, 1.7], 0.0: [-1.0, 2.0, 1.9, 2.1], -0.2: [0.3, 1.7, 1.6, 1.8]}
    assert best_height(scores, 0.4) == 0.0
    assert best_height(scores, -1.0) == -0.2


def test_the_floor_is_judged_by_all_frames_that_show_a_person():
    scores = {0.2: [1.0, 2.0], 0.0: [1.6, 1.9]}
    assert best_height(scores, 0.4) == 0.0
