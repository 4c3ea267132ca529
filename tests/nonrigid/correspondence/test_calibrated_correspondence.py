"""Tracks of calibrated cameras are matched, and those without a partner remain single."""

import numpy as np
import pytest
from tests.nonrigid.made_shapes import three_cameras, without_motion

from marey.errors import MareyError, SettingProblem
from marey.geometry import rotations
from marey.nonrigid.correspondence.calibrated_correspondence import join_calibrated, match_calibrated

FRAMES, POINTS = 60, 60


@pytest.fixture
def views(rng):
    """Three cameras' tracks in an order of their own, each without some points and with gaps; and which points."""
    mean = 0.15 * rng.normal(size=(POINTS, 3))
    modes = without_motion(rng.normal(size=(2, POINTS, 3)), mean - mean.mean(0))
    time = np.arange(FRAMES)
    shape = mean + np.einsum("fm,mpi->fpi", 0.02 * np.stack([np.sin(time / 9), np.cos(time / 5)], 1), modes)
    points = np.einsum("fij,fpj->fpi", rotations.exp(np.cumsum(0.04 * rng.normal(size=(FRAMES, 3)), 0)), shape)
    tracks, which = [], []
    for camera in three_cameras():
        kept = rng.permutation(POINTS)[:50]
        seen = np.moveaxis(camera.project(points[:, kept]), 1, 2) + 0.5 * rng.normal(size=(FRAMES, 2, 50))
        tracks.append(np.where(rng.random((FRAMES, 1, 50)) < 0.2, np.nan, seen))
        which.append(kept)
    return tracks, which


def test_nearly_all_pairs_are_found_and_none_is_wrong(views):
    tracks, which = views
    cameras = three_cameras().cameras
    found = match_calibrated(tracks[0], tracks[1], cameras[:2])
    right = which[0][found.pairs[:, 0]] == which[1][found.pairs[:, 1]]
    shared = len(np.intersect1d(which[0], which[1]))
    assert right.sum() >= 0.95 * shared
    assert (~right).sum() <= 1
    assert found.probability[~right].max(initial=0) < 0.99
    assert len(found.alone_first) == 50 - len(found.pairs)


def test_three_cameras_are_joined(views):
    tracks, which = views
    joined = join_calibrated(tracks, three_cameras())
    labels = np.where(joined.points >= 0, np.take_along_axis(np.stack(which), np.maximum(joined.points, 0), 1), -1)
    shared = labels[:, (joined.points >= 0).sum(0) >= 2]
    one = np.array([len(set(column[column >= 0])) == 1 for column in shared.T])
    assert one.mean() >= 0.95
    assert joined.tracks.shape == (3, FRAMES, 2, labels.shape[1])


def test_the_low_rank_resolves_ambiguous_epipolar_lines(rng):
    """Points along a line that stays in one epipolar plane: the cameras see the same, their depths move apart."""
    time = np.arange(FRAMES)
    mean = 0.15 * rng.normal(size=(30, 3))
    mean[25:, 1:] = mean[25, 1:]
    turns = rotations.exp(np.stack([0 * time, 0 * time, 0.3 * np.sin(time / 10)], 1))
    points = np.einsum("fij,pj->fpi", turns, mean)
    cameras = three_cameras().cameras[:2]
    first, second = (np.moveaxis(camera.project(points), 1, 2) for camera in cameras)
    noise = 0.3 * rng.normal(size=(2, *first.shape))
    found = match_calibrated(first + noise[0], second + noise[1], cameras)
    assert np.mean(found.pairs[:, 0] == found.pairs[:, 1]) >= 0.9


def test_appearance_can_exclude_a_pair(views):
    tracks, _ = views
    cameras = three_cameras().cameras
    looks = np.zeros((50, 50))
    looks[:, 7] = -np.inf
    assert 7 not in match_calibrated(tracks[0], tracks[1], cameras[:2], looks).pairs[:, 1]


def test_arrays_that_do_not_match_are_an_error(views):
    tracks, _ = views
    rig = three_cameras()
    with pytest.raises(SettingProblem, match="same instants"):
        match_calibrated(tracks[0][:5], tracks[1], rig.cameras[:2])
    with pytest.raises(SettingProblem, match="calibration has 3"):
        join_calibrated(tracks[:2], rig)
    with pytest.raises(SettingProblem, match="appearance"):
        match_calibrated(tracks[0], tracks[1], rig.cameras[:2], np.zeros((2, 2)))
    with pytest.raises(MareyError, match="one place"):
        match_calibrated(tracks[0], tracks[1], (rig.cameras[0], rig.cameras[0]))
    few = match_calibrated(tracks[0][:, :, :3], tracks[1][:, :, :3], rig.cameras[:2])
    assert "no pair" in few.notes[0] or len(few.pairs) < 4
