"""Capture of a person: choice of frames, and the complete estimate on a small take."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.person import (
    PersonSettings,
    SilhouetteTake,
    interpolated_poses,
    promising_frames,
    refine_person,
    repair_person,
    shape_frames,
    start_person,
    track_person,
    unsupported_frames,
    with_shape,
)
from marey.fit.recipes.sequence import join_pieces
from marey.fit.search.search import Candidate


def boxes(*spans, size=(60, 80)):
    """One silhouette per camera: a box from x0 to x1 over rows 20 to 40."""
    masks = []
    for span in spans:
        mask = np.zeros(size, bool)
        if span is not None:
            mask[20:40, span[0] : span[1]] = True
        masks.append(mask)
    return masks


def take_of(masks):
    return SilhouetteTake(worlds.ring(2, size=(80, 60)), lambda frame: masks[frame], tuple(range(len(masks))), 30.0)


def test_frames_are_chosen_that_show_all_of_the_person_in_every_camera():
    whole, cut, half = boxes((20, 40), (30, 50)), boxes((0, 20), (30, 50)), boxes((20, 40), None)
    take = take_of([cut, half, whole, half, cut, whole, half, half, cut, whole])
    assert set(promising_frames(take, 3)) <= {2, 5, 9}


def test_chosen_frames_are_spread_over_time():
    take = take_of([boxes((20, 40), (30, 50))] * 120)
    chosen = sorted(promising_frames(take, 3))
    assert len(chosen) == 3
    assert np.diff(chosen).min() >= 18


def test_a_take_of_one_frame_is_tried_at_that_frame():
    assert promising_frames(take_of([boxes((20, 40), (30, 50))]), 3) == [0]


def test_the_shape_is_estimated_from_good_frames_of_the_whole_take():
    scores = {f: 0.5 if 30 <= f < 50 else 0.9 + 1e-4 * f for f in range(100)}
    chosen = shape_frames(scores, 10)
    assert len(chosen) == 10
    assert not set(chosen) & set(range(30, 50))
    assert chosen[0] < 25
    assert chosen[-1] > 90
    assert shape_frames({7: 0.9, 8: 0.9}, 10) == [7, 8]


def test_the_levels_of_a_take_have_the_requested_height():
    body = worlds.person()
    take = worlds.take([PosedBody(body, worlds.pose(body))], worlds.ring(size=(400, 480), focal=600.0))
    height = max(np.count_nonzero(mask.any(1)) for mask in take.masks_of(0))
    assert take.levels(height / 2).factor == 0.5
    assert take.levels(2 * height).factor == 1.0


def test_heights_that_lead_to_one_size_share_levels_which_are_kept_with_either():
    take = take_of([boxes((20, 40), (30, 50))] * 3)
    levels, small = take.levels(20.0), take.levels(10.0)
    assert take.levels(200.0) is levels
    assert small is not levels
    kept, dropped = levels.at(0), small.at(0)
    take.forget(keep=200.0)
    assert levels.at(0) is kept
    assert small.at(0) is not dropped
    take.forget()
    assert levels.at(0) is not kept


def test_a_body_of_another_level_gets_the_same_shape(rng):
    fine, coarse = worlds.person("fine"), worlds.person("coarse")
    covariance = np.eye(6)
    found = replace(fine, numbers=rng.normal(size=6), numbers_covariance=covariance)
    taken = with_shape(found, coarse)
    np.testing.assert_array_equal(taken.numbers, found.numbers)
    assert taken.numbers_covariance is covariance
    assert len(taken.vertices) == len(coarse.vertices)
    np.testing.assert_allclose(taken.joint_centres, found.joint_centres, atol=1e-9)


def test_a_start_in_the_checkpoint_is_reused(monkeypatch):
    body = worlds.person()
    posed = PosedBody(body, worlds.pose(body))
    take = worlds.take([posed] * 3, worlds.ring())
    calls = []

    def find(cameras, masks, coarse, fine, settings):
        calls.append(len(masks))
        return [Candidate(posed, 0.8)]

    monkeypatch.setattr("marey.fit.recipes.person.find_both_ways", find)
    checkpoint = {1: Candidate(posed, 0.9)}
    assert start_person(take, body, body, PersonSettings(), checkpoint=checkpoint) == (1, checkpoint[1])
    assert len(calls) == 2
    monkeypatch.setattr("marey.fit.recipes.person.find_both_ways", lambda *_: [])
    assert start_person(take, body, body, PersonSettings()) is None


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [4, 3])
def test_a_person_is_tracked_in_both_directions_and_refined_with_its_shape(cameras):
    mean = worlds.person("coarse", 3)
    person = mean.with_numbers(np.array([1.0, -0.7, 0.5]))
    truth = [PosedBody(person, pose) for pose in worlds.swing(person, 9)]
    take = worlds.take(truth, worlds.ring()[:cameras])
    settings, finished = PersonSettings(), []
    start = (4, truth[4].pose.step(np.full(len(mean.skeleton), 0.01)))
    found = track_person(take, mean, mean, start, settings, progress=finished.append)
    assert list(found) == list(range(9))
    assert sorted(finished) == list(range(9))
    good = shape_frames({f: c.score for f, c in found.items()}, 6)
    poses = {f: c.posed.pose for f, c in found.items()}
    fit = join_pieces(list(refine_person(take, mean, poses, good, settings, height=160, rounds=12)))
    errors = [worlds.joint_errors(PosedBody(fit.body, p), t).mean() for p, t in zip(fit.poses, truth, strict=True)]
    assert np.mean(errors) < 0.012
    assert np.abs(fit.body.numbers - person.numbers).max() < 0.5


@pytest.mark.slow
def test_single_frames_are_repaired_with_a_better_body():
    body = worlds.person("coarse", 3)
    truth = [PosedBody(body, pose) for pose in worlds.swing(body, 9)]
    poses = {f: t.pose for f, t in enumerate(truth)}
    poses[4] = worlds.pose(body, dict(worlds.ARMS_AND_KNEES) | {"left_shoulder_lift": -35})
    repaired = repair_person(worlds.take(truth, worlds.ring()), body, body, poses, PersonSettings())
    assert list(repaired) == list(range(9))
    assert worlds.joint_errors(PosedBody(body, repaired[4]), truth[4]).max() < 0.03
    assert repaired[0] is poses[0]


def test_a_good_start_is_enough(monkeypatch):
    body = worlds.person()
    posed = PosedBody(body, worlds.pose(body))
    take, calls = worlds.take([posed] * 3, worlds.ring()), []

    def find(cameras, masks, coarse, fine, settings):
        calls.append(masks)
        return [Candidate(posed, 0.97)]

    monkeypatch.setattr("marey.fit.recipes.person.find_both_ways", find)
    start_person(take, body, body, PersonSettings())
    assert len(calls) == 1


def test_short_gaps_are_interpolated():
    body = worlds.person("coarse", 3)
    poses = dict(enumerate(worlds.swing(body, 30)))
    known = {f: pose for f, pose in poses.items() if f not in (4, 5, *range(10, 20), 29)}
    filled = interpolated_poses(known, longest=5.9)
    assert sorted(filled) == [4, 5]
    for frame in filled:
        apart = worlds.joint_errors(PosedBody(body, filled[frame]), PosedBody(body, poses[frame])).max()
        # A leg of .9 m that swings by 25 degrees in 30 frames lies up to .44 (2 pi / 30)^2 = .02 rad off the chord.
        assert apart < 0.02
    np.testing.assert_allclose(known[3].change_to(filled[4]), known[3].change_to(known[6]) / 3, atol=1e-9)
    assert interpolated_poses({}, longest=5) == {}


def test_interpolated_poses_that_disagree_with_silhouettes_are_listed():
    body = worlds.person("coarse", 3)
    truth = [PosedBody(body, pose) for pose in worlds.swing(body, 3)]
    take = worlds.take(truth, worlds.ring())
    wrong = worlds.pose(body, at=(0.5, 0.0, 0.0))
    poses = {0: truth[0].pose, 1: wrong, 2: wrong}
    assert unsupported_frames(take, body, poses, (0, 1), PersonSettings(), usual=0.95) == {1}
