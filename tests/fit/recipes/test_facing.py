"""Facing of a person whom all cameras see from one side, decided by the motion."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes import person as recipe
from marey.fit.recipes.facing import AMBIGUOUS_BELOW, better_followed, facing_as, is_ambiguous
from marey.fit.recipes.person import PersonSettings, start_person
from marey.fit.search.search import Candidate, turned_about

FRAMES = 15


@pytest.fixture(scope="module")
def seen_from_one_side():
    """A person whose arms and legs swing, two cameras before them, and the truth."""
    body = worlds.person("coarse", 3)
    truth = [PosedBody(body, pose) for pose in worlds.swing(body, FRAMES)]
    cameras = tuple(
        worlds.looking_at(np.array([0.0, 0.0, -0.05]), np.array([x, 3.2, 0.3]), name=f"cam{k}")
        for k, x in enumerate((-0.3, 0.4))
    )
    return body, worlds.take(truth, cameras), truth


@pytest.mark.slow
def test_the_way_a_person_faces_follows_from_the_motion(seen_from_one_side):
    body, take, truth = seen_from_one_side
    settings, middle = PersonSettings(), FRAMES // 2
    right = Candidate(truth[middle], 0.8)
    wrong = Candidate(replace(truth[middle], pose=turned_about(truth[middle])), 0.8)
    for starts in ((right, wrong), (wrong, right)):
        found = better_followed(
            starts, middle, take.frames, take.levels(settings.track_height), take.levels(settings.rough_height), body,
            rate=take.rate, settings=settings.track,
        )  # fmt: skip
        assert found is right


def test_only_starts_with_about_the_same_score_are_ambiguous(seen_from_one_side):
    _, _, truth = seen_from_one_side
    best = Candidate(truth[0], 0.9)
    assert is_ambiguous(best, Candidate(truth[0], 0.9 - 0.9 * AMBIGUOUS_BELOW))
    assert not is_ambiguous(best, Candidate(truth[0], 0.9 - 1.1 * AMBIGUOUS_BELOW))


def test_the_start_that_faces_as_another_body_is_found(seen_from_one_side):
    _, _, truth = seen_from_one_side
    right = Candidate(truth[0], 0.70)
    wrong = Candidate(replace(truth[0], pose=turned_about(truth[0])), 0.71)
    assert facing_as(Candidate(truth[3], 0.9), (wrong, right)) is right
    assert facing_as(wrong, (wrong, right)) is wrong


@pytest.mark.parametrize(
    ("scores", "followed"),
    [((0.9, 0.8), []), ((0.9, 0.89), ["person"]), ((0.9,), []), ((0.7, 0.5), ["limb"]), ((), ["limb"])],
    ids=["clear", "ambiguous", "one way only", "not better than the limb", "not found"],
)
def test_an_ambiguous_limb_faces_as_the_whole_person_if_that_is_seen(monkeypatch, seen_from_one_side, scores, followed):
    body, take, truth = seen_from_one_side
    turned, right = Candidate(replace(truth[0], pose=turned_about(truth[0])), 0.71), Candidate(truth[0], 0.70)
    persons = [replace(start, score=score) for start, score in zip((right, turned), scores, strict=False)]
    whole, calls = object(), []

    def find(cameras, masks, coarse, fine, settings):
        return persons if fine is whole else [turned, right]

    def follow(starts, *, coarse, **_):
        calls.append("person" if coarse is whole else "limb")
        return next(start for start in starts if start.posed is truth[0])

    monkeypatch.setattr(recipe, "find_both_ways", find)
    monkeypatch.setattr(recipe, "better_followed", follow)
    found = start_person(take, body, body, PersonSettings(), whole=lambda: (whole, whole))
    assert found is not None
    assert found[1] is right
    assert calls == followed


@pytest.mark.parametrize(("lower", "followed"), [(0.01, True), (0.2, False)])
def test_a_person_who_may_face_the_other_way_is_followed_from_both_starts(
    monkeypatch, seen_from_one_side, lower, followed
):
    body, take, truth = seen_from_one_side
    turned = Candidate(replace(truth[0], pose=turned_about(truth[0])), 0.9 - lower)
    calls = []

    def follow(starts, *_, **__):
        calls.append(starts)
        return starts[1]

    monkeypatch.setattr(recipe, "find_both_ways", lambda *_: [Candidate(truth[0], 0.9), turned])
    monkeypatch.setattr(recipe, "better_followed", follow)
    kept, opposite = {}, {}
    first = start_person(take, body, body, PersonSettings(), checkpoint=kept, opposite=opposite)
    assert first[1].score == (turned.score if followed else 0.9)
    assert len(calls) == followed
    # After an interruption both are known.
    monkeypatch.setattr(recipe, "find_both_ways", lambda *_: pytest.fail("was found before"))
    assert start_person(take, body, body, PersonSettings(), checkpoint=kept, opposite=opposite) == first
