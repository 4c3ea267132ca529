"""The people of a take: their heights, and the one at a pixel, in a box, or at a place."""

import numpy as np
import pytest
from tests import worlds
from tests.detected import JOINTS, detections

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import stature
from marey.fit.recipes.present_people import person_at_pixel, person_at_place, person_in_box, person_of_track
from marey.fit.recipes.seen_people import find_people

CAMERAS = worlds.ring(3, size=(400, 240))
PLACES = ((0.4, 0.0), (-0.6, 0.3))


@pytest.fixture(scope="module")
def people():
    body = worlds.person()
    posed = [[PosedBody(body, worlds.pose(body, {}, at=(x, y, 0)))] * 4 for x, y in PLACES]
    posed[1] = [None, *posed[1][1:]]
    pixels, sure = detections(posed, CAMERAS)
    return [person_of_track(track, JOINTS) for track in find_people(CAMERAS, pixels, sure, rate=worlds.RATE)]


def test_frames_places_and_heights(people):
    assert [person.frames for person in people] == [[0, 1, 2, 3], [1, 2, 3]]
    height, _ = stature(worlds.person())
    for person, place in zip(people, PLACES, strict=True):
        np.testing.assert_allclose(person.middle(2)[:2], place, atol=0.12)
        assert person.height_m == pytest.approx(height, rel=0.05)


def test_a_pixel_finds_the_person_it_shows(people):
    for i, person in enumerate(people):
        for camera in CAMERAS:
            chest = camera.project(person.middle(2))
            other = camera.project(people[1 - i].middle(2))
            if np.linalg.norm(chest - other) > 30:
                assert person_at_pixel(people, camera, chest, 2) == i


def test_nobody_is_far_from_everybody_or_absent(people):
    camera = CAMERAS[0]
    assert person_at_pixel(people, camera, np.array([1.0, 1.0]), 2) is None
    assert person_at_pixel(people[1:], camera, camera.project(people[1].middle(2)), 0) is None


def test_a_box_finds_the_person_who_fills_it(people):
    for i, person in enumerate(people):
        seen = person.pixels(CAMERAS[1], 2)
        box = np.concatenate([seen.min(0) - 4, seen.max(0) + 4])
        assert person_in_box(people, CAMERAS[1], box, 2) == i
        top = np.concatenate([seen.min(0) - 4, seen.min(0) + 4])
        assert person_in_box(people, CAMERAS[1], top, 2) is None


def test_a_place_finds_the_nearest_person_in_one_frame_or_any(people):
    for i, place in enumerate(PLACES):
        assert person_at_place(people, np.array([*place, 0.0]), 2) == i
        assert person_at_place(people, np.array([*place, 1.0])) == i
    assert person_at_place(people, np.array([*PLACES[1], 0.0]), 0) is None
    assert person_at_place(people, np.array([3.0, 3.0, 0.0])) is None
