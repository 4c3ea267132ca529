"""Cameras that do not fit each other are detected: lags, wrong partners, another object."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.many_cameras.view_checks import checked_views

FRAMES, POINTS = 60, 12


@pytest.fixture
def tracks(rng):
    """A rigid cluster that swings unevenly, seen by two cameras with a little noise."""
    time = np.arange(FRAMES)
    swing = np.stack([0.3 * np.sin(time / 5), 0.5 * np.sin(time / 7), 0.2 * np.cos(time / 4)], 1)
    cameras = rotations.exp(np.array([[0.0, 0, 0], [0.1, 0.8, 0.2]]))
    points = rotations.exp(swing) @ rng.normal(size=(3, POINTS))
    return np.einsum("cij,fjp->cfip", cameras[:, :2], points) + 0.005 * rng.normal(size=(2, FRAMES, 2, POINTS))


def test_consistent_tracks_are_not_changed(tracks):
    checked, notes = checked_views(tracks)
    assert notes == ()
    np.testing.assert_array_equal(checked, tracks)


@pytest.mark.parametrize(("late", "shift_text"), [(3, "f + 3 of camera 0"), (-4, "f - 4 of camera 0")])
def test_the_lag_of_unsynchronised_cameras_is_reported(tracks, late, shift_text):
    first, second = (tracks[0, :-late], tracks[1, late:]) if late > 0 else (tracks[0, -late:], tracks[1, :late])
    _, notes = checked_views(np.stack([first, second]))
    assert len(notes) == 1
    assert shift_text in notes[0]


def test_a_wrong_partner_is_removed_and_reported(tracks):
    tracks[1, ..., 3] = tracks[1, ..., 4] + np.sin(np.arange(FRAMES) / 3)[:, None]
    checked, notes = checked_views(tracks)
    assert "numbers 3:" in notes[0]
    assert np.isnan(checked[1, ..., 3]).all()
    np.testing.assert_array_equal(np.delete(checked, 3, -1), np.delete(tracks, 3, -1))
    np.testing.assert_array_equal(checked[0], tracks[0])


def test_tracks_of_other_points_are_an_error(tracks):
    with pytest.raises(MareyError, match="do not match"):
        checked_views(np.stack([tracks[0], tracks[1, ..., ::-1]]))
