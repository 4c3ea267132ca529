import numpy as np
import pytest

from marey.errors import SettingProblem
from marey.images.matching.features import edge_features, good_features


def squares() -> np.ndarray:
    image = np.full((120, 160), 40, np.uint8)
    image[40:80, 50:110] = 200
    return image


def test_corners_of_a_rectangle_are_the_good_features():
    found = good_features(squares(), count=4, spacing=10, size=5)
    corners = np.array([[50, 40], [109, 40], [50, 79], [109, 79]])
    nearest = np.linalg.norm(found[:, None] - corners, axis=2)
    assert len(found) == 4
    # The strongest patch contains the whole corner, so its centre is at most half its size away from it.
    assert np.all(nearest.min(axis=0) <= 3)


def test_edge_features_lie_on_sides_away_from_what_is_taken():
    corners = good_features(squares(), count=4, spacing=10, size=5)
    edges = edge_features(squares(), count=6, taken=corners, spacing=12, size=5)
    assert len(edges) == 6
    near_x = np.abs(edges[:, :1] - [49.5, 109.5]).min(axis=1)
    near_y = np.abs(edges[:, 1:] - [39.5, 79.5]).min(axis=1)
    assert np.all(np.minimum(near_x, near_y) <= 3)
    apart = np.linalg.norm(edges[:, None] - np.concatenate([corners, edges]), axis=2)
    assert np.sort(apart, axis=1)[:, 1].min() >= 12


def test_features_lie_only_where_they_may():
    within = np.zeros((120, 160), bool)
    within[:, :70] = True
    found = good_features(squares(), count=10, spacing=10, size=5, within=within)
    assert len(found) == 2
    assert np.all(found[:, 0] < 70)


def test_a_flat_image_has_no_features():
    assert good_features(np.full((50, 50), 7, np.uint8), count=5).shape == (0, 2)


def test_impossible_requests_are_rejected():
    with pytest.raises(SettingProblem, match="A grey image has"):
        good_features(np.zeros((5, 5, 3), np.uint8), count=5)
    with pytest.raises(SettingProblem, match="odd"):
        good_features(squares(), count=5, size=4)
    with pytest.raises(SettingProblem, match="cannot be chosen"):
        good_features(squares(), count=5, spacing=0)
