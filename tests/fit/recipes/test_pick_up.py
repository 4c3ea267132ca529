"""New starts after a lost track: the frames that are tried, accepted starts, and a person who returns elsewhere."""

from dataclasses import dataclass

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.person import PersonSettings, SilhouetteTake, track_person
from marey.fit.recipes.pick_up import (
    PickUpSettings,
    best_per_frame,
    pick_up,
    restart,
    runs_between,
    weak_frames,
    with_fixed_shape,
)
from marey.fit.search.levels import FrameLevels
from marey.fit.search.search import Candidate, StartSettings

QUICK = StartSettings(yaws=8, kept=2, finalists=1, arm_directions=24, leg_directions=16)
"""Extent of a search that suffices for a body of known shape."""


@dataclass
class Posed:
    """Stands for a posed body where only its pose is passed on."""

    pose: object = None


def scored(score):
    return Candidate(Posed(), score)


def test_stretches_end_at_known_frames_and_at_gaps():
    frames = [0, 1, 2, 3, 4, 6, 7, 30, 31]
    assert runs_between(frames, {2: None}) == [[0, 1], [3, 4], [6, 7], [30, 31]]
    assert runs_between(frames, {2: None}, hole=5) == [[0, 1], [3, 4, 6, 7], [30, 31]]
    assert runs_between(frames, set(frames)) == []


def picked(found, frames, scores, *, reach=10, rate=10.0, settings=None, merit=lambda frame: 0.0):
    """Pick up with starts of given scores, from each of which the person is followed so many frames."""
    tried = []

    def start(frame):
        tried.append(frame)
        return scored(scores[frame]) if frame in scores else None

    def follow(frame, pose, way):
        return {f: scored(0.9) for f in way if abs(f - frame) <= reach}

    return pick_up(found, frames, merit, start, follow, rate=rate, settings=settings), tried


def test_a_new_start_is_tracked_in_both_directions_up_to_known_frames():
    known = {f: scored(0.9) for f in [*range(10), *range(40, 50)]}
    after, tried = picked(known, range(50), {24: 0.88}, reach=100, merit=lambda frame: 100 - abs(frame - 24))
    assert tried == [24]
    assert list(after) == list(range(50))
    assert all(after[f] is known[f] for f in known)


def test_starts_are_half_a_second_apart_and_stop_after_repeated_failures():
    known = {f: scored(0.9) for f in range(10)}
    after, tried = picked(known, range(200), {})
    assert after == known
    assert len(tried) == PickUpSettings().most
    assert np.diff(sorted(tried)).min() >= 5
    # A start whose score is much worse than usual is rejected.
    assert picked(known, range(200), dict.fromkeys(range(200), 0.7))[0] == known


def test_frames_that_a_new_start_does_not_reach_are_tried_again():
    known = {f: scored(0.9) for f in range(10)}
    after, tried = picked(known, range(60), dict.fromkeys(range(60), 0.9), reach=4)
    assert set(range(10, 60)) - set(after) == set()
    assert len(tried) >= 5


def test_frames_with_little_of_the_person_are_not_tried():
    known = {f: scored(0.9) for f in range(10)}
    scores = dict.fromkeys(range(60), 0.9)
    assert picked(known, range(60), scores, merit=lambda frame: 1.0 if frame < 10 else 0.4) == (known, [])
    after, tried = picked(known, range(60), scores, merit=lambda frame: 0.4 if 10 <= frame < 40 else 1.0)
    assert min(tried) >= 40
    assert set(range(40, 60)) <= set(after)


def test_a_short_gap_between_known_frames_is_skipped():
    known = {f: scored(0.9) for f in range(100) if f not in (40, 41)}
    assert picked(known, range(100), {40: 0.9}, rate=30.0) == (known, [])
    assert picked(known, range(100), {40: 0.9}, rate=10.0)[1] == [40]


def test_a_stretch_of_low_score_is_listed_but_no_single_frame():
    found = {f: scored(0.7 if f in (5, 20, 21, 22, 23, 24) else 0.9) for f in range(40)}
    assert weak_frames(found, rate=30.0, settings=PickUpSettings()) == {20, 21, 22, 23, 24}
    assert weak_frames({}, rate=30.0, settings=PickUpSettings()) == set()


def test_the_old_candidate_is_kept_unless_the_new_one_is_better():
    old, new = {1: scored(0.8), 2: scored(0.8), 3: scored(0.8)}, {2: scored(0.805), 3: scored(0.9), 4: scored(0.6)}
    both = best_per_frame(old, new)
    assert list(both) == [1, 2, 3, 4]
    assert [both[f] for f in (1, 2, 3, 4)] == [old[1], old[2], new[3], new[4]]


def test_a_body_without_numbers_keeps_the_shape_that_was_found(rng):
    body = worlds.person("coarse", 4).with_numbers(np.array([1.0, -0.5, 0.3, 0.8]))
    fixed = with_fixed_shape(body)
    assert len(fixed.space) == 0
    np.testing.assert_allclose(fixed.vertices, body.vertices, atol=1e-12)
    np.testing.assert_allclose(fixed.joint_centres, body.joint_centres, atol=1e-12)


@pytest.fixture(scope="module")
def coming_back():
    """A person who leaves, and comes back elsewhere, facing another way with arms and legs in another posture."""
    body, cameras = worlds.person("coarse"), worlds.ring()
    first = [PosedBody(body, pose) for pose in worlds.swing(body, 4)]
    degrees = {"left_elbow_flexion": 80, "right_shoulder_lift": 30, "right_hip_flexion": 30, "right_knee_flexion": 40}
    later = [
        PosedBody(body, worlds.pose(body, degrees, yaw=2.6 + 0.02 * i, at=(0.25, 0.02 * i, 0.0))) for i in range(4)
    ]
    truth = dict(enumerate(first)) | {40 + i: posed for i, posed in enumerate(later)}
    masks = {f: worlds.silhouettes(posed, cameras) for f, posed in truth.items()}
    return body, truth, SilhouetteTake(tuple(cameras), lambda frame: masks[frame], tuple(truth), worlds.RATE)


@pytest.mark.slow
def test_a_person_who_returns_elsewhere_is_found(coming_back):
    body, truth, take = coming_back
    finished = []
    settings = PersonSettings(start=QUICK)
    found = track_person(take, body, body, (0, truth[0].pose), settings, progress=finished.append)
    assert list(found) == [0, 1, 2, 3, 40, 41, 42, 43]
    assert sorted(finished) == list(truth)
    # A pixel is eleven millimetres.
    assert max(worlds.joint_errors(found[f].posed, truth[f]).max() for f in truth) < 0.05


def test_silhouettes_without_a_common_point_give_no_start(coming_back):
    body, _, take = coming_back
    levels = FrameLevels(take.cameras, take.masks_of, 0.5)
    empty = [np.zeros_like(mask) for mask in take.masks_of(0)]
    assert restart(take.cameras, empty, body, body, levels, 0, StartSettings()) is None
