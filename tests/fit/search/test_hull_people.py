"""People in the foreground: counted, linked over frames, and divided where they meet."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.search.hull_people import find_hull_people, hull_height

CAMERAS = worlds.ring(4, size=(320, 240), focal=260.0, distance=4.0)


def foreground(people):
    """The silhouettes of all people together, by frame."""
    views = [worlds.seen(motion, CAMERAS) for motion in people]
    return lambda frame: [np.any([view[frame][c] for view in views], axis=0) for c in range(len(CAMERAS))]


def walk(places):
    body = worlds.person()
    return [PosedBody(body, worlds.pose(body, {}, at=(x, y, 0))) for x, y in places]


def test_two_people_are_followed_through_a_take():
    one, two = walk([(0.6, 0.1 * f) for f in range(5)]), walk([(-0.6, 0.3 - 0.1 * f) for f in range(5)])
    tracks = find_hull_people(CAMERAS, foreground([one, two]), range(5), rate=10.0)
    assert len(tracks) == 2
    places = sorted(tracks, key=lambda track: -track.middle(0)[0])
    for track, true in zip(places, (0.6, -0.6), strict=True):
        assert sorted(track.cells) == list(range(5))
        for f in range(5):
            assert track.middle(f)[0] == pytest.approx(true, abs=0.1)
        assert 1.5 < hull_height(track, 0.08) < 2.0


def test_one_person_is_one():
    tracks = find_hull_people(CAMERAS, foreground([walk([(0.2, 0.1)] * 2)]), range(2), rate=10.0)
    assert [sorted(track.cells) for track in tracks] == [[0, 1]]


def test_people_who_meet_stay_two():
    one, two = walk([(0.6 - 0.12 * f, 0) for f in range(5)]), walk([(-0.6 + 0.12 * f, 0) for f in range(5)])
    tracks = find_hull_people(CAMERAS, foreground([one, two]), range(5), rate=10.0)
    assert [sorted(track.cells) for track in tracks] == [list(range(5))] * 2
    first, second = sorted(tracks, key=lambda track: -track.middle(0)[0])
    assert first.middle(4)[0] > second.middle(4)[0]


def test_one_who_comes_later_is_counted():
    one = walk([(0.6, 0)] * 4)
    two = walk([(-0.6, 0)] * 4)
    late = lambda frame: foreground([one, two] if frame > 1 else [one])(frame)  # noqa: E731
    tracks = find_hull_people(CAMERAS, late, range(4), rate=10.0)
    assert [len(track.cells) for track in tracks] == [4, 2]


def test_an_empty_foreground_holds_nobody():
    nothing = [np.zeros((240, 320), bool) for _ in CAMERAS]
    assert find_hull_people(CAMERAS, lambda frame: nothing, range(3), rate=10.0) == []
