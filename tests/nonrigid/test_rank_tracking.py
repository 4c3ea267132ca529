import numpy as np
import pytest
from tests.warped_video import place, texture, video

from marey.errors import SettingProblem
from marey.images.feature_tracks import follow_points
from marey.images.features import good_features
from marey.nonrigid.rank_tracking import RankSettings, refine_tracks

FRAMES = 24


@pytest.fixture(scope="module")
def made():
    """A video with a bar drawn on it, points at corners and one on the bar, and a cover over a point."""
    pictures = video(FRAMES)
    within = np.zeros(pictures[0].shape, bool)
    within[35:-35, 35:-35] = True
    points = good_features(pictures[0], count=40, spacing=8, within=within)
    grey = np.clip(np.round(texture(seed=9)), 0, 255).astype(np.uint8)
    for t in (8, 9, 10):
        x, y = np.round(place(points[:1], t)[0]).astype(int)
        pictures[t][y - 12 : y + 13, x - 12 : x + 13] = grey[y - 12 : y + 13, x - 12 : x + 13]
    followed = follow_points(pictures, points)
    truth = np.stack([place(points, t).T for t in range(FRAMES)])
    return pictures, followed, truth


def test_refined_tracks_are_whole_and_the_covered_point_is_predicted(made):
    pictures, followed, truth = made
    result = refine_tracks(pictures, followed)
    tracks = result.tracks
    away = np.linalg.norm(tracks.tracks - truth, axis=1)
    assert np.isfinite(away).all()
    assert np.median(away) < 0.1
    assert np.all(tracks.visible ^ tracks.predicted)
    assert tracks.predicted[8:11, 0].all()
    assert away[8:11, 0].max() < 1.0
    # Three maps of two bends each and the turn: the made motion has rank six at most.
    assert result.rank <= 6
    assert result.curve.shape[1] == 2


def test_stated_deviations_hold_the_truth(made):
    pictures, followed, truth = made
    tracks = refine_tracks(pictures, followed).tracks
    inside = np.abs(tracks.tracks - truth)[1:] < 1.96 * tracks.tracks_sd[1:]
    assert 0.85 < inside.mean() <= 1


def test_too_few_points_for_a_rank_are_refused(made):
    pictures, _, truth = made
    followed = follow_points(pictures, truth[0].T[:4])
    with pytest.raises(SettingProblem, match="too few"):
        refine_tracks(pictures, followed, settings=RankSettings(rank=5))
    with pytest.raises(SettingProblem, match="rank 0"):
        RankSettings(rank=0)
