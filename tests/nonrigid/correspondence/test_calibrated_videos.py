"""From the images of calibrated cameras to shapes in the laboratory."""

import numpy as np
import pytest
from tests.filmed_sheet_calibrated import in_space, on_sheet, rig, videos

from marey.cameras.rig import Rig
from marey.errors import MareyError, SettingProblem
from marey.images.matching.epipolar_search import find_on_lines
from marey.nonrigid.correspondence.calibrated_videos import track_calibrated_views
from marey.nonrigid.in_space.calibrated import factorise_calibrated

FRAMES = 12


@pytest.fixture(scope="module")
def filmed():
    return videos(FRAMES)


def true_points(pixels):
    """Where the points (P, 2) that the first camera sees in frame 0 are in all frames (F, P, 3)."""
    places = on_sheet(rig().cameras[0], pixels, 0)
    return np.stack([in_space(places, frame) for frame in range(FRAMES)])


@pytest.mark.slow
def test_points_are_found_on_their_lines(filmed):
    points = np.random.default_rng(0).uniform(45, 115, (30, 2))
    cameras = rig().cameras[:2]
    found = find_on_lines(filmed[0][0], filmed[1][0], points, cameras)
    true = cameras[1].project(true_points(points)[0])
    away = np.linalg.norm(found.pixels - true[found.points], axis=1)
    assert len(np.unique(found.points[away < 0.5])) >= 27


@pytest.mark.slow
def test_videos_become_shapes_in_the_laboratory(filmed):
    within = np.zeros(filmed[0][0].shape, bool)
    within[40:120, 40:120] = True
    views = track_calibrated_views(filmed, rig(), count=40, within=within)
    assert views.tracks.shape[:3] == (3, FRAMES, 2)
    assert views.tracks.shape[3] >= 25
    assert views.notes == ()
    found = factorise_calibrated(views.tracks, rig(), tracks_sd=views.tracks_sd)
    away = np.linalg.norm(found.points - true_points(views.tracks[0, 0].T), axis=-1)
    assert np.nanmedian(away) < 1.0e-3
    assert np.nanquantile(away[found.views >= 2], 0.95) < 4e-3


@pytest.mark.slow
def test_videos_that_do_not_match_are_an_error(filmed):
    with pytest.raises(SettingProblem, match="3 videos, but the calibration has 2"):
        track_calibrated_views(filmed, Rig(rig().cameras[:2]))
    with pytest.raises(MareyError, match="No other camera shares"):
        track_calibrated_views([filmed[0], [image[::-1, ::-1] for image in filmed[1]]], Rig(rig().cameras[:2]))
    with pytest.raises(SettingProblem, match="have the same position"):
        find_on_lines(filmed[0][0], filmed[1][0], np.array([[80.0, 80.0]]), (rig().cameras[0], rig().cameras[0]))
    with pytest.raises(SettingProblem, match="alike must lie between 0 and 1"):
        find_on_lines(filmed[0][0], filmed[1][0], np.array([[80.0, 80.0]]), rig().cameras[:2], alike=2.0)
