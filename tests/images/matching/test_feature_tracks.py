import numpy as np
import pytest
from tests.warped_video import SIZE, picture, place, texture, video

from marey.errors import SettingProblem
from marey.images.matching.feature_tracks import (
    FeatureTracks,
    FollowSettings,
    extrapolated,
    follow_points,
    predicted_by_neighbours,
)
from marey.images.matching.features import good_features

FRAMES = 16


@pytest.fixture(scope="module")
def pictures():
    return video(FRAMES)


def inner_corners(image: np.ndarray, count: int = 25) -> np.ndarray:
    within = np.zeros(image.shape, bool)
    within[35:-35, 35:-35] = True
    return good_features(image, count=count, spacing=9, within=within)


def test_points_are_followed_both_ways_through_a_bending_texture(pictures):
    points = inner_corners(pictures[0])
    start = 5
    followed = follow_points(pictures, place(points, start), frame=start)
    truth = np.stack([place(points, t).T for t in range(FRAMES)])
    away = np.linalg.norm(followed.found.tracks - truth, axis=1)
    assert followed.found.visible.mean() > 0.98
    # Bicubic warping and the bend that an affine patch does not describe cause errors of about 0.1 px.
    assert np.nanmedian(away) < 0.1
    assert np.nanmax(away) < 0.6
    assert not followed.found.predicted.any()


def test_a_covered_point_is_lost_and_found_again(pictures):
    points = inner_corners(pictures[0])
    hidden = points[0]
    covered = [image.copy() for image in pictures]
    grey = np.round(np.clip(texture(seed=9), 0, 255)).astype(np.uint8)
    for t in (4, 5, 6):
        x, y = np.round(place(hidden[None], t)[0]).astype(int)
        covered[t][y - 12 : y + 13, x - 12 : x + 13] = grey[y - 12 : y + 13, x - 12 : x + 13]
    followed = follow_points(covered, points)
    assert not followed.found.visible[4:7, 0].any()
    assert np.isnan(followed.found.tracks[4:7, :, 0]).all()
    assert followed.found.visible[[3, 8], 0].all()
    assert np.linalg.norm(followed.found.tracks[8, :, 0] - place(hidden[None], 8)[0]) < 0.3
    # Meanwhile it is predicted from its neighbours, with an error due to the bend over their distance.
    assert np.linalg.norm(followed.guesses[5, :, 0] - place(hidden[None], 5)[0]) < 1.5


def test_the_first_reference_is_taken_again_when_it_fits_again():
    shares = np.array([0, 0, 0, 0.25, 0.4, 0.5, 0.55, 0.5, 0.4, 0.25, 0, 0])
    one, other = texture(), texture(seed=5)
    pictures = [picture(t, 128 + (1 - s) * (one - 128) + s * (other - 128)) for t, s in enumerate(shares)]
    points = inner_corners(pictures[0], 10)
    followed = follow_points(pictures, points)
    younger = followed.used >= len(points)
    assert younger[6].any()
    assert not younger[[1, 2, 10, 11]].any()
    assert followed.found.visible[-1].sum() >= 9
    away = np.linalg.norm(followed.found.tracks[-1] - place(points, 11).T, axis=0)
    assert np.nanmax(away) < 0.3


def test_a_flat_place_is_never_seen(pictures):
    blank = [image.copy() for image in pictures]
    for image in blank:
        image[60:100, 60:100] = 100
    points = np.concatenate([inner_corners(pictures[0], 10), [[80.0, 80.0]]])
    followed = follow_points(blank, points)
    assert not followed.found.visible[:, -1].any()


def test_neighbours_carry_lost_points_by_their_affine_motion():
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 100, (30, 2))
    moved = points @ np.array([[1.05, 0.1], [-0.08, 0.97]]).T + [5, -3]
    known = moved.copy()
    known[:4] = np.nan
    filled, maps = extrapolated(points, known, points)
    assert np.array_equal(filled[4:], moved[4:])
    assert np.isnan(maps[4:]).all()
    # The weak pull towards a common shift takes a few percent of the stretch over the neighbours' distance.
    assert np.abs(filled[:4] - moved[:4]).max() < 0.5


def test_impossible_points_and_settings_are_rejected(pictures):
    with pytest.raises(SettingProblem, match="frames 0 to"):
        follow_points(pictures, np.array([[50.0, 50.0]]), frame=FRAMES)
    with pytest.raises(SettingProblem, match="not in the image"):
        follow_points(pictures, np.array([[50.0, SIZE + 1.0]]))
    with pytest.raises(SettingProblem, match="shape"):
        follow_points(pictures, np.zeros((2, 3)))
    with pytest.raises(SettingProblem, match="correlation"):
        FollowSettings(alike=1.5)


def test_tracks_that_do_not_fit_together_are_rejected():
    tracks, marks = np.zeros((3, 2, 4)), np.zeros((3, 4), bool)
    with pytest.raises(SettingProblem, match="differ"):
        FeatureTracks(tracks=tracks, tracks_sd=tracks, visible=marks[:2], predicted=marks)
    with pytest.raises(SettingProblem, match="both visible and predicted"):
        FeatureTracks(tracks=tracks, tracks_sd=tracks, visible=~marks, predicted=~marks)


def test_each_point_is_predicted_by_the_others_alone(rng):
    points = rng.uniform(0, 100, size=(20, 2))
    places = points @ [[1.1, 0.2], [-0.1, 0.9]] + (5, -3)
    moved = places.copy()
    moved[4] += 30
    places[7] = moved[7] = np.nan
    predicted = predicted_by_neighbours(points, places)
    assert np.isnan(predicted[7]).all()
    assert np.nanmedian(np.linalg.norm(predicted - places, axis=1)) < 0.5
    np.testing.assert_allclose(predicted_by_neighbours(points, moved)[4], predicted[4])
    assert np.isnan(predicted_by_neighbours(points[:3], points[:3])).all()
