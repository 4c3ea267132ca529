"""Start and tracking by the words of the parts, in painted images."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.regions import WORDS, painted

from marey.body.articulation.pose import PosedBody
from marey.fit.regions.places import PlaceSettings
from marey.fit.regions.region_search import RegionSearch, learned_areas, thinned
from marey.fit.regions.region_track import RegionTrack, RegionTracker, RegionTrackSettings
from marey.fit.search.search import turned_about

RATE = 30.0
PIXEL = 0.03
"""Width of a pixel at the body [m]."""
SETTINGS = RegionTrackSettings(
    places=PlaceSettings(step=0.25, coarse_step=0.5, height_step=0.3, below=1.2, postures=(0, 8), headings=2),
    frames=2, headings=4, kept=2, limb_directions=16, whole_shares=(0.3, 0.1), starts=1, window=0.05,
)  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    """Six frames of a person who swings arms and legs, before a random background."""
    body = thinned(worlds.person())
    cameras = tuple(worlds.ring(size=(96, 96), focal=100.0))
    poses = dict(enumerate(worlds.swing(body, 6)))
    rng = np.random.default_rng(3)
    images = {frame: painted(PosedBody(body, pose), cameras, rng) for frame, pose in poses.items()}
    tracker = RegionTracker(RegionSearch(cameras, WORDS), images.__getitem__, tuple(poses), RATE, SETTINGS)
    return body, poses, tracker


def error(body, pose, true) -> float:
    return float(worlds.joint_errors(PosedBody(body, pose), PosedBody(body, true)).mean())


def known(tracker, body, poses, frame) -> RegionTrack:
    """A track that begins at the true pose of a frame, with the true colours."""
    areas = learned_areas(tracker.search, body, poses, {f: tracker.images_of(f) for f in poses})
    return RegionTrack(body, {frame: poses[frame]}, {}, np.sum(list(areas.values()), axis=0))


def test_tracking_follows_forward_and_backward_from_the_start(scene):
    body, poses, tracker = scene
    called: list[int] = []
    track = tracker.track(known(tracker, body, poses, 3), tracker.frames, progress=called.append)
    assert list(track.poses) == list(track.scores) == list(poses)
    assert sorted(set(called)) == list(poses)
    assert max(error(body, track.poses[f], poses[f]) for f in poses) < PIXEL


def test_a_reduced_tracker_has_fewer_frames_of_the_same_take(scene):
    body, poses, tracker = scene
    fast = replace(tracker, rate=2.5 * SETTINGS.least_rate)
    every = fast.reduced()
    assert every.frames == (0, 2, 4)
    assert every.step == 2
    assert every.rate == fast.rate
    track = every.track(known(tracker, body, poses, 2), every.frames)
    assert list(track.poses) == [0, 2, 4]
    assert max(error(body, track.poses[f], poses[f]) for f in track.poses) < PIXEL
    slow = replace(tracker, rate=0.5 * SETTINGS.least_rate)
    assert slow.reduced().frames == tracker.frames


def test_a_limb_that_was_lost_at_the_start_is_searched_after_some_time(scene):
    body, poses, tracker = scene
    angles = np.array(poses[0].angles)
    angles[body.skeleton.coordinate_names.index("left_shoulder_lift") - 6] += 1.5
    wrist = body.skeleton.segment("left_hand")

    def away(interval: float) -> float:
        own = replace(tracker, settings=replace(SETTINGS, search_interval=interval, fall=1e6))
        lost = replace(known(tracker, body, poses, 0), poses={0: replace(poses[0], angles=angles)})
        pose = own.track(lost, tracker.frames).poses[5]
        origins = [PosedBody(body, each).segment_origin[wrist] for each in (pose, poses[5])]
        return float(np.linalg.norm(origins[0] - origins[1]))

    assert away(2 / RATE) < 2 * PIXEL < away(1e3)


def test_a_wrong_facing_has_a_lower_score_than_the_other_one(scene):
    body, poses, tracker = scene
    right = known(tracker, body, poses, 2)
    about = turned_about(PosedBody(body, poses[2]))
    wrong = replace(right, poses={2: about}, scores={2: 1.0})
    assert tracker.track(wrong, tracker.frames).mean_score < tracker.track(right, tracker.frames).mean_score
    facings = tracker.both_facings(wrong)
    assert len(facings) == 2
    best = max(facings, key=lambda track: track.mean_score)
    assert max(error(body, best.poses[f], poses[f]) for f in poses) < 1.5 * PIXEL


@pytest.mark.slow
def test_sizes_are_estimated_towards_the_true_ones(scene):
    body, poses, tracker = scene
    steps = np.zeros(len(body.numbers))
    steps[0] = 1.5 * np.sqrt(body.space.prior_covariance[0, 0])
    other = body.with_numbers(body.space.prior_mean + steps)
    before = known(tracker, body, poses, 3)
    start = replace(before, body=other, poses=dict(poses), scores=dict.fromkeys(poses, 1.0))
    found = tracker.with_sizes(start)

    def length(candidate):
        return float(np.ptp(candidate.vertices[:, 2]))

    assert abs(length(found.body) - length(body)) < 0.5 * abs(length(other) - length(body))


@pytest.mark.slow
def test_a_person_is_found_without_any_prior_knowledge(scene):
    body, poses, tracker = scene
    called: list[int] = []
    started = tracker.start(body, progress=called.append)
    assert started is not None
    assert called == [0, 5, 0, 5]
    best = max(tracker.both_facings(started), key=lambda track: track.mean_score)
    assert np.mean([error(body, best.poses[f], poses[f]) for f in poses]) < 2 * PIXEL


def test_nobody_is_found_where_no_two_cameras_see_a_place(scene):
    body, _, tracker = scene
    alone = RegionSearch(tracker.search.cameras[:1], WORDS)
    first = tracker.images_of(0)
    cut = replace(first, words=first.words[:1], evidence=first.evidence[:1])
    assert replace(tracker, search=alone, images_of=lambda frame: cut).start(body) is None


def test_frames_with_a_low_score_show_nobody(scene):
    body, poses, _ = scene
    scores = {0: 5.0, 1: 6.0, 2: 1.0, 3: 5.5, 4: -2.0, 5: 5.0}
    track = RegionTrack(body, poses, scores, np.zeros(0)).shown(0.4)
    assert list(track.poses) == list(track.scores) == [0, 1, 3, 5]
    assert track.mean_score == pytest.approx(21.5 / 4)


def test_a_limb_that_is_lost_for_some_frames_is_followed_back_into_them(scene):
    body, poses, tracker = scene
    start = known(tracker, body, poses, 3)
    track = tracker.track(start, tracker.frames)
    elbow = [coordinate.name for coordinate in body.skeleton.coordinates].index("left_elbow_flexion")
    lost, scores = dict(track.poses), dict(track.scores)
    for frame in (2, 3):
        angles = np.array(lost[frame].angles)
        angles[elbow] += 1.2
        lost[frame] = replace(lost[frame], angles=angles)
        table = tracker.search.word_table(
            start.learned, PosedBody(body, lost[frame]), tracker.images_of(frame), whole_share=0.1
        )
        scores[frame] = float(tracker.search.scores(body, [lost[frame]], tracker.images_of(frame), table)[0])
    called: list[int] = []
    found = tracker.swept_again(replace(track, poses=lost, scores=scores), progress=called.append)
    assert sorted(called) == sorted([*poses, *poses])
    assert all(found.scores[frame] >= scores[frame] for frame in poses)
    assert max(error(body, found.poses[f], poses[f]) for f in poses) < 1.2 * PIXEL


def test_a_known_pose_is_followed_with_the_colours_of_its_own_frame(scene):
    body, poses, tracker = scene
    every = replace(tracker, rate=2.5 * SETTINGS.least_rate).reduced(through=3)
    assert every.frames == (1, 3, 5)
    started = every.started_at(PosedBody(body, poses[3]), 3)
    assert list(started.poses) == [3]
    track = every.track(started, every.frames)
    assert list(track.poses) == [1, 3, 5]
    assert max(error(body, track.poses[f], poses[f]) for f in track.poses) < PIXEL
