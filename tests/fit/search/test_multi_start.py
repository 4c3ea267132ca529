"""Starts sampled about a prediction: where they lie, and that silhouettes choose the right one among them."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.recipes.track import TrackSettings, prediction_spread
from marey.fit.search.multi_start import SampleSettings, best_of_samples, sampled_poses, shift_to_silhouettes

SETTINGS = SampleSettings()


@pytest.fixture(scope="module")
def leap():
    """A person, and the silhouettes of the same person half a metre on and turned by 40 degrees."""
    body, cameras = worlds.person("coarse"), worlds.ring()
    before = worlds.pose(body)
    after = PosedBody(body, worlds.pose(body, yaw=np.deg2rad(40), at=(0.3, -0.35, 0.1)))
    return before, after, worlds.levels([after], cameras).at(0), worlds.levels([after], cameras, 0.5).at(0)


def spread_of(body, rate=10.0):
    return prediction_spread(body.skeleton, TrackSettings(), rate=rate)


def test_the_silhouettes_centroids_give_the_persons_shift(leap):
    _, after, fine, _ = leap
    elsewhere = replace(after.pose, translation=after.pose.translation - [0.3, -0.2, 0.1])
    moved = PosedBody(after.body, elsewhere)
    # The middle of an outline is not a point of the body, but nearly: a pixel is eleven millimetres.
    np.testing.assert_allclose(shift_to_silhouettes(moved, fine), [0.3, -0.2, 0.1], atol=0.03)
    np.testing.assert_allclose(shift_to_silhouettes(after, fine), 0.0, atol=1e-12)


def test_a_silhouette_in_one_camera_alone_gives_no_shift(leap):
    _, after, fine, _ = leap
    blank = fine.at_size(fine.cameras, [fine.masks[0], *[np.zeros_like(m) for m in fine.masks[1:]]])
    np.testing.assert_array_equal(shift_to_silhouettes(after, blank), 0.0)


def test_samples_include_the_predictions_and_are_reproducible(leap):
    before, after, _, rough = leap
    step = np.full(len(after.body.skeleton), 0.05)
    first, second = (sampled_poses(after.body, before, step, spread_of(after.body), rough, SETTINGS) for _ in range(2))
    assert len(first) == 2 * len(SETTINGS.momenta) + 3 * SETTINGS.samples
    for pose, again in zip(first, second, strict=True):
        np.testing.assert_array_equal(pose.change_to(again), 0.0)
    for pose, momentum in zip(first, SETTINGS.momenta, strict=False):
        np.testing.assert_allclose(before.change_to(pose), momentum * step, atol=1e-12)


def test_samples_turn_about_the_vertical_more_than_they_tilt_and_never_too_far(leap):
    before, after, _, rough = leap
    spread = np.full(len(after.body.skeleton), np.deg2rad(40.0))
    many = SampleSettings(samples=400)
    poses = sampled_poses(after.body, before, np.zeros(len(spread)), spread, rough, many)[2:]
    turns = np.array([before.change_to(pose)[3:] for pose in poses])
    # 800 samples (a still person has one prediction, moved or not): their spread is known to a fortieth.
    np.testing.assert_allclose(turns[:, 3:].std(0), many.rest * spread[6:], rtol=0.15)
    assert np.abs(turns[:, 2]).std() > 2 * np.abs(turns[:, 0]).std()
    wide = SampleSettings(samples=400, rest=10.0)
    poses = sampled_poses(after.body, before, np.zeros(len(spread)), spread, rough, wide)[2:]
    angles = np.array([pose.angles - before.angles for pose in poses])
    np.testing.assert_allclose(angles.std(0), wide.farthest_turn, rtol=0.15)


def test_a_leap_is_found_by_samples_where_one_start_fails(leap):
    before, after, fine, rough = leap
    body = after.body
    step = np.zeros(len(body.skeleton))
    found = best_of_samples(body, before, step, spread_of(body), fine, rough, coarse=body)
    assert worlds.joint_errors(PosedBody(body, before), after).max() > 0.4
    assert found.score > 0.9
    assert worlds.joint_errors(found.posed, after).max() < 0.05
