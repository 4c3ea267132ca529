"""A person who is lost and found again, in painted images."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.regions import WORDS, painted

from marey.body.articulation.pose import PosedBody
from marey.fit.regions import recovery
from marey.fit.regions.places import PlaceSettings
from marey.fit.regions.recovery import find_again
from marey.fit.regions.region_search import RegionSearch, learned_areas, thinned
from marey.fit.regions.region_track import RegionTrack, RegionTracker, RegionTrackSettings

RATE = 30.0
AWAY = range(3, 6)
"""Frames in which nobody is present."""
JUMP = 1.0
"""Distance of the places before and after them [m]."""
SETTINGS = RegionTrackSettings(
    places=PlaceSettings(step=0.25, postures=(0, 8), headings=4), headings=4, kept=2, limb_directions=16,
    whole_shares=(0.3, 0.1),
)  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    """A person who goes away and comes back at another place, before a random background."""
    body = thinned(worlds.person())
    cameras = tuple(worlds.ring(size=(96, 96), focal=80.0))
    rng = np.random.default_rng(5)
    poses = {f: worlds.pose(body, at=(-0.5 + (JUMP if f >= AWAY.stop else 0.0), 0.0, 0.0)) for f in range(12)}
    images = {frame: painted(PosedBody(body, pose), cameras, rng) for frame, pose in poses.items()}
    for frame in AWAY:
        images[frame] = replace(images[frame], words=rng.integers(0, WORDS, images[frame].words.shape))
    tracker = RegionTracker(RegionSearch(cameras, WORDS), images.__getitem__, tuple(poses), RATE, SETTINGS)
    areas = learned_areas(tracker.search, body, {0: poses[0]}, images)
    return body, poses, tracker, tracker.track(RegionTrack(body, {0: poses[0]}, {}, areas[0]), tracker.frames)


@pytest.mark.slow
def test_a_person_who_comes_back_elsewhere_is_found_again(scene, monkeypatch):
    monkeypatch.setattr(recovery, "EVERY_S", 0.1)
    body, poses, tracker, track = scene
    back = [frame for frame in poses if frame >= AWAY.stop]

    def errors(found, frames):
        return [worlds.joint_errors(PosedBody(body, found.poses[f]), PosedBody(body, poses[f])).mean() for f in frames]

    assert min(errors(track, back)) > 0.5 * JUMP
    called: list[int] = []
    found = find_again(tracker, track, progress=called.append)
    assert set(back) <= set(called)
    assert list(found.poses) == list(poses)
    # A pixel is 4 cm wide; a person who faces the other way is 300 mm off.
    assert max(errors(found, back)) < 0.15
    assert list(found.shown(SETTINGS.least_share).poses) == [frame for frame in poses if frame not in AWAY]


def test_a_track_without_lost_frames_is_not_searched(scene):
    _, poses, tracker, track = scene
    kept = [frame for frame in poses if frame < AWAY.start]
    good = replace(track, poses={f: track.poses[f] for f in kept}, scores={f: track.scores[f] for f in kept})
    called: list[int] = []
    found = find_again(tracker, good, progress=called.append)
    assert not called
    assert found.poses == good.poses


def test_nobody_is_found_where_nobody_is(scene):
    _, poses, tracker, track = scene
    kept = [frame for frame in poses if frame < AWAY.stop]
    lost = replace(track, poses={f: track.poses[f] for f in kept}, scores={f: track.scores[f] for f in kept})
    found = find_again(tracker, lost)
    assert list(found.shown(SETTINGS.least_share).poses) == [frame for frame in kept if frame not in AWAY]
