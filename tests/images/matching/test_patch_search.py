import numpy as np
import pytest
from tests.filmed_sheet import SIZE, on_sheet, picture, place, texture

from marey.errors import SettingProblem
from marey.images.matching.features import good_features
from marey.images.matching.patch_search import PatchSearchSettings, find_beside, find_candidates


@pytest.fixture(scope="module")
def pair():
    grey = texture(3)
    first, second = picture(2, 0, grey), picture(2, 1, grey)
    within = np.zeros((SIZE, SIZE), bool)
    within[50:150, 50:150] = True
    points = good_features(first, count=30, within=within)
    return first, second, points, place(on_sheet(points, 2, 0), 2, 1)


def test_candidates_lie_on_the_points(pair):
    first, second, points, truth = pair
    found = find_candidates(first, second, points, alike=0.9)
    away = np.linalg.norm(found.pixels - truth[found.points], axis=1)
    assert len(np.unique(found.points[away < 0.5])) >= 20
    assert np.mean(away < 0.5) > 0.9


def test_the_remaining_points_are_found_beside_their_neighbours(pair):
    first, second, points, truth = pair
    known = np.where(np.arange(len(points))[:, None] < 10, truth, np.nan)
    places, correlation = find_beside(first, second, points, known)
    away = np.linalg.norm(places - truth, axis=1)
    assert np.isfinite(away).mean() > 0.8
    assert np.nanmedian(away) < 0.2
    assert np.array_equal(np.isfinite(correlation), np.isfinite(places[:, 0]) & ~np.isfinite(known[:, 0]))


def test_the_settings_limit_the_passes_of_the_search(pair):
    first, second, points, truth = pair
    known = np.where(np.arange(len(points))[:, None] < 10, truth, np.nan)
    places, _ = find_beside(first, second, points, known, settings=PatchSearchSettings(rounds=0))
    np.testing.assert_array_equal(places, known)


def test_a_blank_image_has_no_candidates(pair):
    first, second, points, _ = pair
    found = find_candidates(first, np.full_like(second, 100), points)
    assert len(found.points) == 0


def test_impossible_numbers_are_rejected(pair):
    with pytest.raises(SettingProblem, match=r"alike = 1\.5"):
        find_candidates(pair[0], pair[1], pair[2], alike=1.5)
