"""Several answers to the same outlines: found, decided by all frames, or both kept."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes import hypotheses
from marey.fit.recipes.hypotheses import (
    WIDEST_SHARE,
    Alternative,
    HypothesisSettings,
    explore_hypotheses,
    with_alternatives,
)
from marey.fit.recipes.sequence import SequenceFit
from marey.fit.search.limb_moves import limb_chains, swung

FRAMES = 13
BENT = {**worlds.ARMS_AND_KNEES, "left_elbow_flexion": 80}


@pytest.fixture(scope="module")
def motion():
    body = worlds.scan()
    return body, dict(enumerate(worlds.swing(body, FRAMES, first=BENT)))


def levels(motion, cameras):
    body, poses = motion
    return worlds.levels([PosedBody(body, pose) for pose in poses.values()], cameras)


def explored(motion, start, cameras, **settings):
    body = motion[0]
    seen = levels(motion, cameras)
    return explore_hypotheses(
        seen, seen, seen, body, body, start, rate=worlds.RATE, settings=HypothesisSettings(**settings)
    )  # fmt: skip


def elbow_errors(motion, poses):
    body, truth = motion
    at = body.skeleton.segment("left_forearm")
    return np.array([
        np.linalg.norm(PosedBody(body, poses[f]).segment_origin[at] - PosedBody(body, truth[f]).segment_origin[at])
        for f in truth
    ])  # fmt: skip


def wrongly_swung(motion, frames):
    body, truth = motion
    arm = limb_chains(body.skeleton)[0]
    return {f: swung(PosedBody(body, p), arm, np.deg2rad(120)) if f in frames else p for f, p in truth.items()}


@pytest.mark.slow
def test_an_arm_that_was_swung_to_the_wrong_side_is_found_by_all_frames(motion):
    start = wrongly_swung(motion, range(3, 9))
    found = explored(motion, start, worlds.ring())
    assert elbow_errors(motion, start).max() > 0.1
    assert elbow_errors(motion, found.poses).max() < 0.04
    assert {former.name for former in found.replaced} == {"left arm"}
    assert not found.alternatives


def test_nothing_changes_where_the_views_determine_the_posture(motion):
    found = explored(motion, motion[1], worlds.ring())
    assert found.poses == motion[1]
    assert not found.alternatives
    assert not found.replaced


@pytest.mark.slow
def test_only_the_given_frames_are_tried_and_the_finished_share_grows(motion, monkeypatch):
    start = wrongly_swung(motion, range(3, 9))
    seen = levels(motion, worlds.ring())
    tried: set[int] = set()
    fitted = hypotheses._Work.fitted_others

    def noted(self, group, frame, beside):
        tried.add(frame)
        return fitted(self, group, frame, beside)

    monkeypatch.setattr(hypotheses._Work, "fitted_others", noted)
    for only in ([], [5, 6]):
        shares: list[float] = []
        explore_hypotheses(
            seen, seen, seen, motion[0], motion[0], start, rate=worlds.RATE, only=only, progress=shares.append
        )  # fmt: skip
        assert tried == set(only)
        assert bool(shares) == bool(only)
        assert np.all(np.diff([0.0, *shares, 1.0001]) > 0)


def test_after_a_replaced_answer_only_frames_near_it_are_tried_again(motion):
    body, poses = motion
    seen = levels(motion, worlds.ring(1))
    work = hypotheses._Work(seen, seen, body, 10.0, HypothesisSettings(longest=2.0))
    former = [hypotheses.Alternative("left arm", np.array([20]), dict.fromkeys(frames, poses[0]), 0.1)
              for frames in (range(100, 110), range(400, 401))]  # fmt: skip
    assert work.near(range(0, 500, 10), former) == [*range(80, 130, 10), *range(380, 421, 10)]


@pytest.mark.slow
def test_the_result_of_a_limb_is_stored_and_used_again(motion):
    start = wrongly_swung(motion, range(3, 9))
    seen, stored = levels(motion, worlds.ring()), dict[str, hypotheses.OtherPostures]()

    def kept(limb, compute):
        stored[limb] = stored.get(limb) or compute()
        return stored[limb]

    def run():
        return explore_hypotheses(
            seen, seen, seen, motion[0], motion[0], start, rate=worlds.RATE, checkpoint=kept
        )  # fmt: skip

    first = run()
    assert list(stored) == ["left arm", "right arm", "left leg", "right leg"]
    # A limb's result contains the frames that changed alone.
    assert set(range(3, 9)) <= set(stored["left arm"].poses)
    again = run()
    assert all(again.poses[f] is first.poses[f] for f in first.poses)
    assert (again.alternatives, again.replaced) == (first.alternatives, first.replaced)


def test_where_no_frame_decides_both_answers_are_kept(motion):
    # One camera sees the arms from above the shoulder: nothing in front of it decides the depth of the elbow.
    found = explored(motion, motion[1], worlds.ring(1), clearly=1e6, hopeless=1e6, possible=0.0)
    assert found.poses == motion[1]
    assert found.alternatives
    for other in found.alternatives:
        assert 0.0 <= other.probability <= 1.0
        frames = sorted(other.poses)
        assert frames == list(range(frames[0], frames[-1] + 1))


@pytest.mark.slow
def test_an_answer_is_followed_no_longer_than_stated(motion):
    # Nothing ends an answer here, and it is not blended with the present one.
    settings = {"clearly": 1e6, "hopeless": 1e6, "possible": 0.0, "merged": 0.0, "approach": 0.0}
    found = explored(motion, motion[1], worlds.ring(1), longest=2.0 / worlds.RATE, **settings)
    assert max(len(other.poses) for other in found.alternatives) == 5
    longer = explored(motion, motion[1], worlds.ring(1), longest=20.0 / worlds.RATE, **settings)
    assert max(len(other.poses) for other in longer.alternatives) == FRAMES


def test_a_posture_that_was_replaced_remains_as_another_answer(motion):
    found = explored(motion, motion[1], worlds.ring(1), clearly=-500.0, hopeless=1e6, possible=0.0, passes=1)
    assert found.replaced
    names = {former.name for former in found.replaced}
    # The last one of each limb was not replaced again.
    last = [[former for former in found.replaced if former.name == name][-1] for name in sorted(names)]
    assert all(former in found.alternatives for former in last)


@pytest.mark.slow
def test_the_covariance_of_two_answers_is_that_of_their_mixture(motion, rng):
    body, poses = motion
    degrees = len(body.skeleton)
    arm = limb_chains(body.skeleton)[0]
    columns = 6 + arm.coordinates
    spread = 0.01 * rng.normal(size=(degrees, degrees)) / np.sqrt(degrees)
    fit = SequenceFit(
        frames=np.array([4, 5]), poses=(poses[4], poses[5]), body=body,
        covariance=np.stack([spread @ spread.T] * 2), information=np.stack([np.eye(degrees)] * 2), residual_px=1.0,
    )  # fmt: skip
    change = np.zeros(degrees)
    change[columns] = 0.3 * rng.normal(size=len(columns))
    other = Alternative("left arm", columns, {5: poses[5].step(change)}, 0.4)
    found = with_alternatives(fit, [other]).covariance
    np.testing.assert_array_equal(found[0], fit.covariance[0])
    draws = (
        rng.normal(size=(200000, degrees)) @ spread.T + np.where(rng.random(200000) < 0.4, 1.0, 0.0)[:, None] * change
    )
    second = draws.T @ draws / len(draws)
    np.testing.assert_allclose(found[1], second, atol=0.01 * np.abs(second).max())
    # However improbable the other answer is, the interval contains it.
    rare = with_alternatives(fit, [replace(other, probability=0.06)]).covariance[1]
    assert np.all(1.96 * np.sqrt(np.diag(rare)[columns]) >= np.abs(change[columns]) * (1 - 1e-9))
    assert pytest.approx(0.26, abs=0.001) == WIDEST_SHARE
