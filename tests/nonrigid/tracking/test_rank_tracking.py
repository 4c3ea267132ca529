from dataclasses import replace

import numpy as np
import pytest
from tests.warped_video import picture, place, texture, video

from marey.errors import SettingProblem
from marey.images.matching.feature_tracks import follow_points
from marey.images.matching.features import good_features
from marey.nonrigid.tracking.rank_tracking import RankTrackingSettings, refine_tracks

FRAMES = 24


def inner(image: np.ndarray) -> np.ndarray:
    within = np.zeros(image.shape, bool)
    within[35:-35, 35:-35] = True
    return within


@pytest.fixture(scope="module")
def made():
    """A video, points at its corners, and a cover that passes before one of them."""
    pictures = video(FRAMES)
    points = good_features(pictures[0], count=40, spacing=8, within=inner(pictures[0]))
    grey = np.clip(np.round(texture(seed=9)), 0, 255).astype(np.uint8)
    for t in (8, 9, 10):
        x, y = np.round(place(points[:1], t)[0]).astype(int)
        pictures[t][y - 12 : y + 13, x - 12 : x + 13] = grey[y - 12 : y + 13, x - 12 : x + 13]
    followed = follow_points(pictures, points)
    truth = np.stack([place(points, t).T for t in range(FRAMES)])
    return pictures, followed, truth


@pytest.mark.slow
def test_refined_tracks_are_complete_and_the_covered_point_is_predicted(made):
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


@pytest.mark.slow
def test_the_standard_deviations_are_valid(made):
    pictures, followed, truth = made
    tracks = refine_tracks(pictures, followed).tracks
    inside = np.abs(tracks.tracks - truth)[1:] < 1.96 * tracks.tracks_sd[1:]
    assert 0.85 < inside.mean() <= 1


@pytest.mark.slow
def test_points_on_an_edge_are_constrained_by_corners():
    grey = texture()
    grey[60:105] = 60
    grey[60:82] = 190
    pictures = [picture(t, grey) for t in range(FRAMES)]
    within = np.zeros(grey.shape, bool)
    within[30:50, 30:-30] = within[112:-30, 30:-30] = True
    corners = good_features(pictures[0], count=30, spacing=8, within=within)
    edges = np.stack([np.arange(50.0, 110.0, 12.0), np.full(5, 81.5)], axis=1)
    followed = follow_points(pictures, np.concatenate([corners, edges]))
    assert not followed.found.visible[1:, -5:].any()
    result = refine_tracks(pictures, followed)
    truth = np.stack([place(edges, t).T for t in range(FRAMES)])
    away = np.linalg.norm(result.tracks.tracks[:, :, -5:] - truth, axis=1)
    start = np.linalg.norm(followed.guesses[:, :, -5:] - truth, axis=1)
    assert result.tracks.visible[:, -5:].mean() > 0.9
    assert np.mean(away) < 0.5 * np.mean(start)


@pytest.mark.slow
def test_drift_of_later_references_is_corrected():
    one, other = texture(), texture(seed=5)
    points = good_features(one, count=40, spacing=8, within=inner(one))
    rows, columns = np.mgrid[: one.shape[0], : one.shape[1]]
    changing = np.zeros(one.shape)
    for x, y in points[::8]:
        changing += np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 6**2))
    pictures = []
    for t in range(FRAMES):
        share = np.clip(0.06 * (t - 10), 0, 0.6) * np.clip(changing, 0, 1)
        pictures.append(picture(t, 128 + (1 - share) * (one - 128) + share * (other - 128)))
    followed = follow_points(pictures, points)
    younger = followed.used >= len(points)
    assert younger.any()
    result = refine_tracks(pictures, followed)
    truth = np.stack([place(points, t).T for t in range(FRAMES)])
    before = np.linalg.norm(followed.found.tracks - truth, axis=1)[younger]
    after = np.linalg.norm(result.tracks.tracks - truth, axis=1)[younger]
    assert np.mean(after**2) < np.mean(before**2)


@pytest.mark.slow
def test_a_point_that_slid_off_is_detected_by_its_neighbours(made):
    pictures, followed, truth = made
    tracks, used = np.array(followed.found.tracks), followed.used.copy()
    tracks[12:, :, 5] += 12.0
    used[12:, 5] = truth.shape[2]
    slid = replace(followed, found=replace(followed.found, tracks=tracks), used=used)
    away = np.linalg.norm(refine_tracks(pictures, slid).tracks.tracks - truth, axis=1)
    assert away[:, 5].max() < 1.0


def test_too_few_points_for_a_rank_are_an_error(made):
    pictures, _, truth = made
    followed = follow_points(pictures, truth[0].T[:4])
    with pytest.raises(SettingProblem, match="too few"):
        refine_tracks(pictures, followed, settings=RankTrackingSettings(rank=5))
    with pytest.raises(SettingProblem, match="rank 0"):
        RankTrackingSettings(rank=0)
