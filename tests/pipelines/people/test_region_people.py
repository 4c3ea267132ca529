"""The people who were tracked by regions: their order, the followed one, and the others."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.errors import SettingProblem
from marey.fit.regions.region_track import RegionTrack
from marey.io.trial.person_choice import PersonNumber, PersonPlace
from marey.pipelines.people.region_people import (
    followed_region,
    longest_first,
    others_of_regions,
    person_of_region,
)
from marey.pipelines.progress import RecordingProgress

BODY = worlds.person()


def track(frames: range, x: float, score: float = 1.0) -> RegionTrack:
    poses = {frame: worlds.pose(BODY, at=(x, 0.0, 0.0)) for frame in frames}
    return RegionTrack(BODY, poses, dict.fromkeys(poses, score), np.zeros(0))


def test_who_is_present_longest_comes_first():
    short, worse, better = track(range(5), 0.0, 9.0), track(range(8), 1.0, 2.0), track(range(8), 2.0, 3.0)
    assert longest_first([short, worse, better]) == [better, worse, short]


def test_the_user_chooses_among_them():
    tracks = [track(range(8), 0.0), track(range(8), 2.0)]
    progress, trial = RecordingProgress(), SimpleNamespace(follow=None, rig=None)
    assert followed_region(trial, tracks, progress) == 0
    assert followed_region(SimpleNamespace(follow=PersonNumber(2), rig=None), tracks, progress) == 1
    place = PersonPlace(2.1, 0.0, 1.0)
    assert followed_region(SimpleNamespace(follow=place, rig=None), tracks, progress) == 1
    with pytest.raises(SettingProblem, match="only 2 people"):
        followed_region(SimpleNamespace(follow=PersonNumber(3), rig=None), tracks, progress)


def test_a_person_has_the_joints_and_the_stature_of_the_body():
    person = person_of_region(BODY, track(range(2), 0.5).poses)
    assert person.frames == [0, 1]
    np.testing.assert_allclose(
        person.points[1], PosedBody(BODY, worlds.pose(BODY, at=(0.5, 0.0, 0.0))).segment_origin
    )  # fmt: skip
    assert person.height_m == pytest.approx(np.ptp(BODY.vertices[:, 2]))


def test_the_others_are_all_but_the_followed_one_and_those_who_are_known_better():
    tracks = [track(range(8), 0.0), track(range(8), 1.0), track(range(8), 2.0)]
    people = [(each.body, each.poses) for each in tracks]
    assert others_of_regions(people[:1], 0, 3.0, ()) is None
    others = others_of_regions(people, 0, 3.0, {2})
    assert others is not None
    [camera, *_] = worlds.ring(1, size=(320, 240))
    seen = others.regions(3, 0, camera, np.zeros(3))
    assert seen is not None
    [alone] = worlds.silhouettes(PosedBody(BODY, tracks[2].poses[3]), [camera])
    np.testing.assert_array_equal(seen.front | seen.behind, alone)


def test_short_gaps_of_others_are_interpolated():
    whole = track(range(8), 1.0)
    gap = replace(whole, poses={frame: pose for frame, pose in whole.poses.items() if frame not in (3, 4)})
    [camera, *_] = worlds.ring(1, size=(320, 240))
    people = [(whole.body, track(range(8), 0.0).poses), (gap.body, gap.poses)]
    for longest, found in ((3.0, True), (1.0, False)):
        others = others_of_regions(people, 0, longest, ())
        assert others is not None
        assert (others.regions(3, 0, camera, np.zeros(3)) is not None) == found


def test_without_a_choice_the_person_of_the_given_joints_is_followed():
    tracks = [track(range(8), 0.0), track(range(4), 2.0)]
    progress = RecordingProgress()
    assert followed_region(SimpleNamespace(follow=None, rig=None), tracks, progress, tracks[1]) == 1
    assert followed_region(SimpleNamespace(follow=PersonNumber(1), rig=None), tracks, progress, tracks[1]) == 0
