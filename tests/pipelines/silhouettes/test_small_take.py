"""A take in reduced images: learned backgrounds, and the evidence of pixels."""

from dataclasses import replace

import numpy as np
import pytest
from tests.walking_take import walking_take

from marey.body.articulation.pose import PosedBody
from marey.fit.regions.region_track import RegionTrack
from marey.images.silhouettes.background import background_of
from marey.images.silhouettes.colour_words import motion_ratio
from marey.observations.correspondence import view_of
from marey.pipelines.people.other_regions import PosedPerson
from marey.pipelines.silhouettes import small_take
from marey.pipelines.silhouettes.small_take import PLATE_RATIO, SmallTake, far_from, plate_ratio


@pytest.fixture
def take(rng) -> tuple[SmallTake, RegionTrack, np.ndarray]:
    return walking_take(rng)


def test_the_background_is_learned_where_the_person_is_elsewhere(take):
    small, track, rooms = take
    learned = small.with_backgrounds(track, 0.05)
    for c, background in enumerate(learned.backgrounds):
        free = background.confidence > 0.9
        assert free.mean() > 0.5
        np.testing.assert_allclose(background.mean[free], rooms[c][free], atol=1)
        always = np.all([view_of(PosedBody(track.body, p), small.cameras[c]).mask() for p in track.poses.values()], 0)
        assert not background.confidence[always].any()


def test_the_background_is_not_learned_where_other_people_may_be(take):
    small, track, _ = take
    other = track.poses[min(track.poses)]
    stays = PosedPerson(track.body, dict.fromkeys(track.poses, other), 0.02)
    alone, beside = small.with_backgrounds(track, 0.05), small.with_backgrounds(track, 0.05, stays)
    for c, camera in enumerate(small.cameras):
        there = view_of(PosedBody(track.body, other), camera).mask()
        assert alone.backgrounds[c].confidence[there].max() > 0
        assert not beside.backgrounds[c].confidence[there].any()


def test_frames_without_the_person_show_what_it_always_hides(take):
    small, track, rooms = take
    # Here the person stays at one place, except for some frames at the end in which it is gone.
    first = min(track.poses)
    stays = {frame: track.poses[first] for frame in track.poses}
    shown = {frame: small.pictures[first] for frame in track.poses}
    gone = {max(shown) + 10 + i: [np.round(room).astype(np.uint8) for room in rooms] for i in range(5)}
    take = replace(small, pictures=shown | gone, _classes={})
    learned = take.with_backgrounds(replace(track, poses=stays), 0.05)
    without = replace(take, pictures=shown).with_backgrounds(replace(track, poses=stays), 0.05)
    for c, (background, before) in enumerate(zip(learned.backgrounds, without.backgrounds, strict=True)):
        inside = view_of(PosedBody(track.body, track.poses[first]), small.cameras[c]).mask()
        assert not before.confidence[inside].any()
        assert background.confidence[inside].min() == 1
        np.testing.assert_allclose(background.mean[inside], rooms[c][inside], atol=2)


def test_frames_near_tracked_ones_are_not_far_from_them():
    assert far_from(range(12), [4, 5, 6]) == [0, 1, 9, 10, 11]
    # Where only every second frame is tracked, those between are not far.
    assert far_from(range(20), [0, 2, 4, 6, 10]) == [15, 16, 17, 18, 19]
    assert far_from([], [1]) == []


def test_the_evidence_of_a_frame_is_that_of_motion_and_of_the_learned_background(take):
    small, track, _ = take
    before, after = small.images_of(4), small.with_backgrounds(track, 0.05).images_of(4)
    assert np.isin(before.evidence, motion_ratio(np.arange(6, dtype=np.uint8)[None])).all()
    np.testing.assert_array_equal(after.words, before.words)
    posed, backgrounds = PosedBody(track.body, track.poses[4]), small.with_backgrounds(track, 0.05).backgrounds
    masks = np.stack([view_of(posed, camera).mask() for camera in small.cameras])
    sure = np.stack([background.confidence for background in backgrounds]) > 0.9
    change = after.evidence - before.evidence
    assert np.count_nonzero(masks & sure) > 20
    assert change[masks & sure].mean() > 1
    assert change[~masks & sure].mean() < -1


def test_the_evidence_of_a_frame_is_computed_once_as_long_as_it_is_kept(take, monkeypatch):
    monkeypatch.setattr(small_take, "IMAGES_KEPT", 2)
    small = replace(take[0])
    first = small.images_of(4)
    assert small.images_of(4) is first
    for frame in (5, 6):
        small.images_of(frame)
    again = small.images_of(4)
    assert again is not first
    np.testing.assert_array_equal(again.evidence, first.evidence)


def test_the_ratio_of_a_learned_background_grows_with_the_difference_as_far_as_it_is_certain():
    mean = np.full((9, 9, 3), 100.0, np.float32)
    picture = np.full((9, 9, 3), 100, np.uint8)
    picture[4, 4], picture[4, 5] = 110, 180
    sure = plate_ratio(picture, background_of(mean, confidence=np.ones((9, 9), np.float32)))
    half = plate_ratio(picture, background_of(mean, confidence=np.full((9, 9), 0.5, np.float32)))
    unknown = plate_ratio(picture, background_of(mean, confidence=np.zeros((9, 9), np.float32)))
    assert -PLATE_RATIO <= sure[0, 0] < half[0, 0] < 0
    assert sure[0, 0] < sure[4, 4] < sure[4, 5] <= PLATE_RATIO
    assert 0 < half[4, 5] < sure[4, 5]
    assert not unknown.any()


def test_a_given_background_is_evidence_from_the_first_track_on_and_is_not_learned(take):
    small, track, rooms = take
    given = replace(small, given={1: background_of(rooms[1].astype(np.float32))})
    plain, known = small.images_of(4).evidence, given.images_of(4).evidence
    mask = view_of(PosedBody(track.body, track.poses[4]), small.cameras[1]).mask()
    assert (known[1] - plain[1])[mask].mean() > 1
    assert (known[1] - plain[1])[~mask].max() < -1
    np.testing.assert_array_equal(np.delete(known, 1, 0), np.delete(plain, 1, 0))
    learned = given.with_backgrounds(track, 0.05)
    assert learned.backgrounds[1] is given.given[1]
    np.testing.assert_array_equal(
        learned.backgrounds[0].mean, small.with_backgrounds(track, 0.05).backgrounds[0].mean
    )  # fmt: skip
