"""Other people beside a tracked one, in painted images."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.regions import WORDS, painted

from marey.body.articulation.pose import PosedBody
from marey.fit.regions.places import PlaceSettings
from marey.fit.regions.region_people import (
    ImagesBeside,
    find_clear_people,
    find_other_people,
    may_show,
    visible_area,
)
from marey.fit.regions.region_search import NO_EVIDENCE, PARTS, RegionSearch, learned_areas, thinned
from marey.fit.regions.region_track import RegionTrack, RegionTracker, RegionTrackSettings
from marey.observations.correspondence import view_of

RATE = 30.0
SETTINGS = RegionTrackSettings(
    places=PlaceSettings(step=0.25, coarse_step=0.5, height_step=0.3, below=1.2, postures=(0, 8), headings=2),
    frames=2, headings=4, kept=2, limb_directions=16, whole_shares=(0.3, 0.1),
)  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    """Two people who stand 1.1 m apart for three frames; the second one's parts have words of their own."""
    body = thinned(worlds.person())
    cameras = tuple(worlds.ring(size=(110, 96), focal=80.0))
    first, second = worlds.pose(body, at=(-0.5, 0.0, 0.0)), worlds.pose(body, at=(0.6, 0.2, 0.0))
    rng = np.random.default_rng(7)
    images, alone = {}, {}
    for frame in range(3):
        one, two = (painted(PosedBody(body, pose), cameras, rng) for pose in (first, second))
        words = np.array(one.words)
        for c, camera in enumerate(cameras):
            own = view_of(PosedBody(body, second), camera).mask()
            nearer = np.linalg.norm(second.translation - camera.centre) < np.linalg.norm(
                first.translation - camera.centre
            )
            shown = own if nearer else own & ~view_of(PosedBody(body, first), camera).mask()
            words[c][shown] = two.words[c][shown] + PARTS
        images[frame], alone[frame] = replace(one, words=words), one
    tracker = RegionTracker(RegionSearch(cameras, WORDS), images.__getitem__, tuple(images), RATE, SETTINGS)
    areas = learned_areas(tracker.search, body, {0: first}, images)
    track = RegionTrack(body, dict.fromkeys(images, first), dict.fromkeys(images, 0.0), areas[0])
    track = tracker.track(replace(track, poses={1: first}), tracker.frames)
    return body, tracker, track, second, alone


@pytest.mark.slow
def test_a_second_person_is_found_and_tracked(scene):
    body, tracker, track, second, _ = scene
    found = find_other_people(tracker, body, track)
    assert len(found) == 1
    assert list(found[0].poses) == [0, 1, 2]
    for pose in found[0].poses.values():
        assert np.linalg.norm((pose.translation - second.translation)[:2]) < 0.1


@pytest.mark.slow
def test_a_second_person_is_clear_without_a_background_and_tracked_again_with_one(scene):
    body, tracker, track, second, _ = scene
    clear = find_clear_people(tracker, body, track)
    assert len(clear) == 1
    assert list(clear[0].poses) == [0, 1, 2]
    # A background that shows the second person as a part of the room hides it, unless the person is known already.
    where = {c: view_of(PosedBody(body, second), camera).mask() for c, camera in enumerate(tracker.search.cameras)}

    def in_the_room(frame):
        images = tracker.images_of(frame)
        evidence = np.array(images.evidence)
        for c, mask in where.items():
            evidence[c][mask] -= 3.0
        return replace(images, evidence=evidence)

    assert find_other_people(replace(tracker, images_of=in_the_room), body, track) == []
    again = find_other_people(tracker, body, track, clear)
    assert len(again) == 1
    for pose in again[0].poses.values():
        assert np.linalg.norm((pose.translation - second.translation)[:2]) < 0.1


def test_the_visible_area_is_that_of_the_pixels_that_are_evidence(scene):
    _, tracker, track, _, _ = scene
    whole = visible_area(tracker, track)
    # The area of a standing person in each of the four images lies between that from the side and that from the front.
    assert 0.2 * len(tracker.search.cameras) < whole < 0.9 * len(tracker.search.cameras)
    nobody = replace(tracker, images_of=ImagesBeside(tracker.images_of, tracker.search.cameras, [track]))
    assert visible_area(nobody, track) == 0


@pytest.mark.slow
def test_nobody_is_found_beside_a_single_person(scene):
    body, tracker, track, _, alone = scene
    single = replace(tracker, images_of=alone.__getitem__)
    assert find_clear_people(single, body, track) == []
    assert find_other_people(single, body, track) == []


def test_a_tracked_person_is_no_evidence_for_another_one(scene):
    body, tracker, track, _second, _ = scene
    cameras, images = tracker.search.cameras, tracker.images_of(0)
    beside = ImagesBeside(tracker.images_of, cameras, [track])(0)
    for c, camera in enumerate(cameras):
        hidden = may_show(PosedBody(body, track.poses[0]), camera)
        np.testing.assert_array_equal(beside.words[c] == NO_EVIDENCE, hidden)
        np.testing.assert_array_equal(beside.words[c][~hidden], images.words[c][~hidden])
    # Its score is that of the angles alone: nothing speaks for or against it where it stands.
    table = np.ones((len(cameras), PARTS, WORDS))
    score = tracker.search.scores(body, [track.poses[0]], beside, table)
    nothing = tracker.search.scores(body, [track.poses[0]], beside, 0 * table)
    np.testing.assert_allclose(score, nothing)


def test_a_person_behind_the_followed_one_hides_nothing_but_is_no_evidence_for_it(scene):
    body, tracker, track, second, _ = scene
    other = replace(track, poses=dict.fromkeys(track.poses, second))
    lit = replace(tracker.images_of(0), evidence=np.ones(tracker.images_of(0).words.shape))
    beside = ImagesBeside(lambda frame: lit, tracker.search.cameras, [other], track)(0)
    nearer = [
        np.linalg.norm(second.translation - camera.centre) < np.linalg.norm(track.poses[0].translation - camera.centre)
        for camera in tracker.search.cameras
    ]
    assert any(nearer)
    assert not all(nearer)
    for c, camera in enumerate(tracker.search.cameras):
        shown = may_show(PosedBody(body, second), camera)
        assert (beside.words[c] == NO_EVIDENCE).any() == nearer[c]
        assert not beside.evidence[c][shown].any()
        assert (beside.evidence[c][~shown] == 1).all()
