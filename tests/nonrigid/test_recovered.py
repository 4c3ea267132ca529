"""One form for all that was found: what is left out, put back, and scaled."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.nonrigid.one_view import factorise_tracks
from marey.nonrigid.recovered import from_one_view, known_distance, usable, widened


def test_frames_and_points_that_hold_too_little_are_found_until_nothing_changes():
    seen = np.ones((8, 6), bool)
    seen[0, :3] = False
    seen[1:, 5] = False
    frames, points = usable(seen[None], least_points=4, least_frames=3)
    assert np.flatnonzero(~frames).tolist() == [0]
    assert np.flatnonzero(~points).tolist() == [5]


def test_too_little_altogether_is_an_error():
    with pytest.raises(MareyError, match="6 points over 2 frames hold too little"):
        usable(np.ones((1, 2, 6), bool), least_points=4, least_frames=3)


@pytest.fixture(scope="module")
def found():
    rng = np.random.default_rng(1)
    angle = 0.2 * np.arange(20)
    turn = np.zeros((20, 3, 3))
    turn[:, 0, 0], turn[:, 0, 2], turn[:, 1, 1] = np.cos(angle), np.sin(angle), 1
    turn[:, 2, 0], turn[:, 2, 2] = -np.sin(angle), np.cos(angle)
    return from_one_view(factorise_tracks((turn @ rng.normal(size=(3, 12)))[:, :2]))


def test_an_answer_for_a_part_is_put_among_all_frames_and_points(found):
    frames, points = np.ones(22, bool), np.ones(13, bool)
    frames[[0, 5]], points[2] = False, False
    wide = widened(found, frames, points)
    np.testing.assert_array_equal(wide.shape[np.ix_(frames, np.arange(3), points)], found.shape)
    assert np.isnan(wide.shape[0]).all()
    assert np.isnan(wide.shape[:, :, 2]).all()
    assert np.flatnonzero(~wide.answered).tolist() == [0, 5]
    assert not wide.predicted[0].any()
    assert widened(found, np.ones(20, bool), np.ones(12, bool)) is found


def test_a_known_distance_scales_and_its_gauge_takes_the_place_of_the_unknown_one(found):
    scaled = known_distance(found, 0, 3, 0.25)
    apart = np.linalg.norm(found.shape[:, :, 0] - found.shape[:, :, 3], axis=1)
    assert np.median(apart) * scaled.metres_per_unit == pytest.approx(0.25)
    assert scaled.metres_per_unit_sd < 1e-3 * scaled.metres_per_unit
    assert sum(line.startswith("Scale") for line in scaled.gauge) == 1


@pytest.mark.parametrize("given", [(0, 0, 1.0), (0, 12, 1.0), (-1, 2, 1.0), (0, 1, 0.0), (0, 1, np.nan)])
def test_an_impossible_distance_is_an_error(found, given):
    with pytest.raises(MareyError):
        known_distance(found, *given)
