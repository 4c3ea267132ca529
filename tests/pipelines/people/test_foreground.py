"""The person to follow among several in the foreground, and silhouettes without the others."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds
from tests.detected import detections

from marey.body.articulation.pose import PosedBody
from marey.cameras.rig import Rig
from marey.errors import SettingProblem
from marey.fit.recipes.seen_people import find_people
from marey.io.trial.person_choice import parse_person
from marey.pipelines.people.foreground import foreground_person
from marey.pipelines.progress import RecordingProgress

CAMERAS = worlds.ring(4, size=(320, 240), focal=260.0, distance=4.0)
COUNT = 6


class Reports(RecordingProgress):
    """Keeps what is reported."""

    def __init__(self):
        super().__init__()
        self.reports: list[str] = []

    def report(self, text):
        self.reports.append(text)


@pytest.fixture(scope="module")
def scene():
    """One person in all frames, another in the last five."""
    body = worlds.person()
    one = [PosedBody(body, worlds.pose(body, at=(0.6, 0.05 * f, 0))) for f in range(COUNT)]
    two = [PosedBody(body, worlds.pose(body, at=(-0.6, 0.2 - 0.05 * f, 0))) for f in range(COUNT)]
    views = worlds.seen(one, CAMERAS), worlds.seen(two, CAMERAS)
    nothing = np.zeros((240, 320), bool)
    views[1][0] = [nothing] * 4
    return (one, two), views


def both(views):
    return lambda frame: [a | b for a, b in zip(views[0][frame], views[1][frame], strict=True)]


def trial(follow=None):
    take = SimpleNamespace(rate=10.0, count=COUNT, first=0, end=COUNT)
    choice = None if follow is None else parse_person(follow)
    return SimpleNamespace(follow=choice, start=None, rig=Rig(CAMERAS), take=take)


@pytest.mark.slow
@pytest.mark.parametrize(("follow", "who"), [(None, 0), ("1", 0), ("2", 1), ("-0.6,0.1,0", 1)])
def test_the_longest_present_person_is_followed_or_the_named_one(scene, follow, who):
    people, views = scene
    progress = Reports()
    found = foreground_person(trial(follow), CAMERAS, both(views), range(COUNT), progress)
    assert found is not None
    true = people[who][3].segment_origin.mean(0)
    np.testing.assert_allclose(found.track.middle(3)[:2], true[:2], atol=0.12)
    assert f"2 people; number {who + 1}" in progress.reports[0]


def test_silhouettes_are_those_of_the_person_where_nobody_is_in_front(scene):
    _, views = scene
    found = foreground_person(trial(), CAMERAS, both(views), range(COUNT), Reports())
    assert found is not None
    own, hidden = found.silhouettes(3, CAMERAS, both(views)(3))
    for mask, behind, true, other in zip(own, hidden, views[0][3], views[1][3], strict=True):
        clear = ~behind
        assert np.count_nonzero(mask & true & clear) > 0.98 * np.count_nonzero(true & clear)
        assert np.count_nonzero(mask & other & ~true & clear) < 0.02 * np.count_nonzero(other)
        assert np.count_nonzero(behind & other) > 0.95 * np.count_nonzero(other)
    alone, free = found.silhouettes(0, CAMERAS, both(views)(0))
    assert not any(mask.any() for mask in free)
    for mask, true in zip(alone, views[0][0], strict=True):
        assert np.count_nonzero(mask & true) > 0.99 * np.count_nonzero(true)


@pytest.mark.slow
def test_detected_joints_choose_the_same_person(scene):
    people, views = scene
    pixels, sure = detections([people[1]], CAMERAS)
    [track] = find_people(CAMERAS, pixels, sure, rate=10.0)
    found = foreground_person(trial(), CAMERAS, both(views), range(COUNT), Reports(), track)
    assert found is not None
    assert found.track.middle(3)[0] < 0


@pytest.mark.slow
def test_people_who_are_modelled_otherwise_are_left_out_of_the_rough_ones(scene):
    _, views = scene
    found = foreground_person(trial(), CAMERAS, both(views), range(COUNT), Reports(), None, {2})
    assert found is not None
    assert len(found.others.tracks) == 1
    assert len(found.rough.tracks) == 0


@pytest.mark.slow
def test_a_single_person_needs_no_separation(scene):
    _, views = scene
    assert foreground_person(trial(), CAMERAS, lambda frame: views[0][frame], range(COUNT), Reports()) is None
    assert foreground_person(trial("1"), CAMERAS, lambda frame: views[0][frame], range(COUNT), Reports()) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("follow", "wrong"), [("3", "only 2 people"), ("cam01:2,2@3", "nobody was found in this part")]
)
def test_nobody_there_is_an_error(scene, follow, wrong):
    _, views = scene
    with pytest.raises(SettingProblem, match=wrong):
        foreground_person(trial(follow), CAMERAS, both(views), range(COUNT), Reports())
