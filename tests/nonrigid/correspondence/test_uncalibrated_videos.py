import numpy as np
import pytest
from tests.filmed_sheet import SIZE, on_sheet, place, videos

from marey.errors import MareyError, SettingProblem
from marey.nonrigid.correspondence.uncalibrated_videos import track_views

FRAMES = 10


@pytest.fixture(scope="module")
def filmed():
    return videos(FRAMES)


@pytest.fixture(scope="module")
def middle():
    within = np.zeros((SIZE, SIZE), bool)
    within[50:150, 50:150] = True
    return within


@pytest.mark.slow
def test_the_same_points_are_followed_in_all_cameras(filmed, middle):
    found = track_views(filmed, count=40, within=middle)
    assert found.tracks.shape[:3] == (2, FRAMES, 2)
    assert found.tracks.shape[3] >= 25
    points = on_sheet(found.tracks[0, 0].T, 0, 0)
    for camera in range(2):
        truth = np.stack([place(points, frame, camera).T for frame in range(FRAMES)])
        away = np.linalg.norm(found.tracks[camera] - truth, axis=1)
        assert np.mean(np.isfinite(away)) > 0.9
        assert np.nanmedian(away) < 0.1
        assert np.nanmax(away) < 1.0
    assert np.nanmin(found.probability) >= 0.5


@pytest.mark.slow
def test_points_and_frame_can_be_given(filmed):
    random = np.random.default_rng(0)
    points = random.uniform(60, 140, (25, 2))
    found = track_views(filmed[:2], points=points, frame=6)
    given = found.tracks[0, 6].T
    assert all(np.min(np.linalg.norm(points - own, axis=1)) < 1e-9 for own in given if np.isfinite(own).all())
    assert found.start == 6


def test_another_surface_shares_no_points(filmed, middle):
    other = [view[::-1, ::-1] for view in filmed[1][::-1]]
    with pytest.raises(MareyError, match="No other camera shares"):
        track_views([filmed[0], other], count=40, within=middle)


def test_videos_of_different_lengths_are_an_error(filmed):
    with pytest.raises(SettingProblem, match="10, 9 frames"):
        track_views([filmed[0], filmed[1][1:]])
    with pytest.raises(SettingProblem, match="two videos"):
        track_views(filmed[:1])
    with pytest.raises(SettingProblem, match="Frame 10"):
        track_views(filmed, frame=10)


def test_a_wall_without_texture_has_nothing_to_follow():
    blank = [np.full((SIZE, SIZE), 128, np.uint8)] * 5
    with pytest.raises(MareyError, match="points can be followed"):
        track_views([blank, blank])
