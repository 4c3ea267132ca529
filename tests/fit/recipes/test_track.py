"""Frame-to-frame tracking of known motions."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose, PosedBody
from marey.fit.recipes import track as track_module
from marey.fit.recipes.track import TrackSettings, prediction_spread, repair, track, uncovered_share
from marey.fit.search.levels import FrameLevels
from marey.fit.search.search import Candidate, Search, StartSettings
from marey.process import limited_cores

FRAMES = 12


@pytest.fixture(scope="module")
def motion():
    """A motion of the coarse body, and its silhouettes at two sizes."""
    body, cameras = worlds.person("coarse"), worlds.ring()
    truth = [PosedBody(body, pose) for pose in worlds.swing(body, FRAMES)]
    masks = worlds.seen(truth, cameras)
    fine, rough = (FrameLevels(cameras, lambda frame: masks[frame], factor) for factor in (1.0, 0.5))
    return truth, fine, rough


def errors(found, truth):
    return np.array([worlds.joint_errors(found[f].posed, truth[f]).max() for f in sorted(found)])


def test_a_motion_is_tracked_to_its_end(motion):
    truth, fine, rough = motion
    start = truth[0].pose.step(np.full(len(truth[0].body.skeleton), 0.02))
    finished = []
    found = track(truth[0].body, start, range(FRAMES), fine, rough, rate=30, progress=finished.append)
    assert list(found) == finished == list(range(FRAMES))
    # A pixel is eleven millimetres; the whole outline fixes a joint to a part of it, and toes to about two.
    assert errors(found, truth).max() < 0.03
    assert np.mean([worlds.joint_errors(found[f].posed, truth[f]).mean() for f in found]) < 0.008
    assert min(c.score for c in found.values()) > 0.9


def test_a_motion_is_tracked_backwards(motion):
    truth, fine, rough = motion
    found = track(truth[0].body, truth[-1].pose, reversed(range(FRAMES)), fine, rough, rate=30)
    assert errors(found, truth).max() < 0.03


def test_a_lower_frame_rate_is_tracked(motion):
    truth, fine, rough = motion
    found = track(truth[0].body, truth[0].pose, range(0, FRAMES, 3), fine, rough, rate=10)
    assert list(found) == [0, 3, 6, 9]
    assert max(worlds.joint_errors(found[f].posed, truth[f]).max() for f in found) < 0.04


def test_a_person_who_leaves_the_images_is_lost(motion):
    truth, fine, _ = motion
    cameras = fine.at(0).cameras
    masks = [list(fine.at(f).masks) for f in range(FRAMES)]
    masks[6:] = [[np.zeros_like(m) for m in masks[0]]] * 6
    levels = FrameLevels(cameras, lambda frame: masks[frame], 1.0)
    found = track(truth[0].body, truth[0].pose, range(FRAMES), levels, levels, rate=30)
    assert list(found) == list(range(6))


def without(levels, gone):
    """The same silhouettes, with no person in some frames."""
    cameras = levels.at(0).cameras
    empty = [np.zeros_like(m) for m in levels.at(0).masks]
    return FrameLevels(cameras, lambda frame: empty if frame in gone else levels.at(frame).masks, 1.0)


def test_a_person_who_is_lost_briefly_is_found_again(motion):
    truth, fine, rough = motion
    levels, small = without(fine, (4, 5, 6)), without(rough, (4, 5, 6))
    found = track(truth[0].body, truth[0].pose, range(FRAMES), levels, small, rate=30)
    assert list(found) == [0, 1, 2, 3, 7, 8, 9, 10, 11]
    assert errors(found, truth).max() < 0.03


@pytest.mark.parametrize(("rate", "expected"), [(30, [0, 1, 2, 8, 9, 10, 11]), (10, [0, 1, 2])])
def test_a_gap_longer_than_half_a_second_ends_a_track(motion, rate, expected):
    truth, fine, rough = motion
    frames = [0, 1, 2, 8, 9, 10, 11]
    found = track(truth[0].body, truth[0].pose, frames, fine, rough, rate=rate)
    assert list(found) == expected
    assert errors(found, truth).max() < 0.03


def test_no_motion_is_repeated_across_a_gap(motion, monkeypatch):
    truth, fine, rough = motion
    predictions = {}
    follow = track_module._fit_prediction

    def spy(predicted, levels, frame, spread, settings):
        predictions[frame] = predicted.pose, spread
        return follow(predicted, levels, frame, spread, settings)

    monkeypatch.setattr(track_module, "_fit_prediction", spy)
    found = track(truth[0].body, truth[0].pose, [0, 1, 2, 6, 7, 8], fine, rough, rate=30)
    np.testing.assert_array_equal(predictions[6][0].angles, found[2].posed.pose.angles)
    np.testing.assert_array_equal(predictions[7][0].angles, found[6].posed.pose.angles)
    assert not np.array_equal(predictions[8][0].angles, found[7].posed.pose.angles)
    np.testing.assert_allclose(predictions[6][1], 3 * predictions[7][1])


def test_candidates_in_the_checkpoint_are_reused(motion):
    truth, fine, rough = motion
    checkpoint = {f: Candidate(truth[f], 0.99) for f in range(4)}
    found = track(truth[0].body, truth[0].pose, range(6), fine, rough, rate=30, checkpoint=checkpoint)
    assert all(found[f].posed is truth[f] for f in range(4))
    assert set(checkpoint) == set(range(6))
    assert errors(found, truth).max() < 0.03


def test_a_limb_that_jumps_is_found(motion):
    truth, fine, _ = motion
    body, cameras = truth[0].body, fine.at(0).cameras
    raised = dict(worlds.ARMS_AND_KNEES) | {"left_shoulder_lift": -35, "left_elbow_flexion": 10}
    jumped = [truth[0], truth[0], PosedBody(body, worlds.pose(body, raised))]
    levels, rough = worlds.levels(jumped, cameras), worlds.levels(jumped, cameras, 0.5)
    found = track(body, jumped[0].pose, range(3), levels, rough, rate=30)
    wrist = list(body.joint_names).index("left_wrist")
    assert worlds.joint_errors(jumped[1], jumped[2])[wrist] > 0.5
    assert worlds.joint_errors(found[2].posed, jumped[2])[wrist] < 0.05


@pytest.mark.slow
def test_a_wrong_frame_is_repaired_from_its_neighbours(motion):
    truth, fine, rough = motion
    search = [Search(fine.at(f), StartSettings()) for f in range(9)]
    found = {f: search[f].judge(truth[f]) for f in range(9)}
    wrong = worlds.pose(truth[4].body, dict(worlds.ARMS_AND_KNEES) | {"left_shoulder_lift": -35})
    found[4] = search[4].judge(PosedBody(truth[4].body, wrong))
    repaired = repair(found, fine, rough, coarse=truth[0].body, rate=30)
    assert worlds.joint_errors(found[4].posed, truth[4]).max() > 0.3
    assert worlds.joint_errors(repaired[4].posed, truth[4]).max() < 0.03
    assert all(repaired[f] is found[f] for f in (0, 1, 7, 8))
    assert found[4] is not repaired[4]


def test_short_sequences_are_not_repaired(motion):
    truth, fine, rough = motion
    found = {f: Candidate(truth[f], 0.5) for f in range(4)}
    assert repair(found, fine, rough, coarse=truth[0].body, rate=30) == found


def test_the_prediction_is_less_certain_at_a_lower_frame_rate():
    skeleton, settings = worlds.person().skeleton, TrackSettings()
    usual = prediction_spread(skeleton, settings, rate=30)
    assert usual[6 + worlds.column(skeleton, "left_elbow_flexion")] == settings.limb_turn
    assert usual[6 + worlds.column(skeleton, "neck_flexion")] == settings.trunk_turn
    np.testing.assert_allclose(prediction_spread(skeleton, settings, rate=15), 2 * usual)
    # The factor is bounded for very low and very high rates.
    np.testing.assert_allclose(prediction_spread(skeleton, settings, rate=1), 3 * usual)
    np.testing.assert_allclose(prediction_spread(skeleton, settings, rate=1000), 0.25 * usual)


def test_the_uncovered_share_excludes_thin_edges(motion):
    truth, fine, _ = motion
    body, level = truth[0].body, fine.at(0)
    assert uncovered_share(truth[0], level) == 0.0
    thin = level.at_size(level.cameras, [cv2.dilate(m.astype(np.uint8), np.ones((3, 3))) > 0 for m in level.masks])
    assert uncovered_share(truth[0], thin) == 0.0
    elsewhere = PosedBody(body, worlds.pose(body, dict(worlds.ARMS_AND_KNEES) | {"left_shoulder_lift": -35}))
    # A forearm and a hand are some hundredths of a person.
    assert uncovered_share(elsewhere, level) > 0.02
    empty_level = level.at_size(level.cameras, [np.zeros_like(m) for m in level.masks])
    assert uncovered_share(truth[0], empty_level) == 0.0


@pytest.mark.slow
def test_a_run_of_wrong_frames_is_repaired_from_both_ends(motion):
    truth, fine, rough = motion
    search = [Search(fine.at(f), StartSettings()) for f in range(FRAMES)]
    found = {f: search[f].judge(truth[f]) for f in range(FRAMES)}
    for f in (4, 5, 6):
        angles = np.array(truth[f].pose.angles)
        angles[worlds.column(truth[f].body.skeleton, "left_elbow_flexion")] = np.deg2rad(130)
        wrong = Pose(truth[f].pose.translation, truth[f].pose.rotation, angles)
        found[f] = search[f].judge(PosedBody(truth[f].body, wrong))
    repaired = repair(found, fine, rough, coarse=truth[0].body, rate=30)
    before, after = (max(worlds.joint_errors(c[f].posed, truth[f]).max() for f in (4, 5, 6)) for c in (found, repaired))
    assert before > 0.2
    assert after < 0.03


@pytest.mark.slow
def test_repairs_do_not_depend_on_cores_nor_on_where_they_are_stored(motion):
    """A store on disk gives equal candidates that are other objects; the search for unrepaired frames is kept."""

    class Stored(dict):
        def __getitem__(self, key):
            return replace(super().__getitem__(key))

    truth, fine, rough = motion
    search = [Search(fine.at(f), StartSettings()) for f in range(9)]
    found = {f: search[f].judge(truth[f]) for f in range(9)}
    wrong = worlds.pose(truth[4].body, dict(worlds.ARMS_AND_KNEES) | {"left_shoulder_lift": -35})
    for f in (4, 5):
        found[f] = search[f].judge(PosedBody(truth[f].body, wrong))
    results = []
    for cores in (1, 2):
        for store in (dict, Stored):
            with limited_cores(cores):
                results.append(repair(found, fine, rough, coarse=truth[0].body, rate=30, checkpoint=store()))
    for other in results[1:]:
        for f in range(9):
            np.testing.assert_array_equal(other[f].posed.pose.angles, results[0][f].posed.pose.angles)
            assert other[f].score == results[0][f].score
