import numpy as np
import pytest

from marey.errors import MareyError
from marey.nonrigid.core.track_checks import check_tracks

CAMERAS, FRAMES, POINTS = 2, 8, 6


def tracks() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(CAMERAS, FRAMES, 2, POINTS))


def test_places_with_both_coordinates_are_seen():
    given = tracks()
    given[1, 3, 0, 2] = np.nan
    seen = check_tracks(given, points=4, frames=5)
    assert seen.shape == (CAMERAS, FRAMES, POINTS)
    assert np.argwhere(~seen).tolist() == [[1, 3, 2]]
    assert check_tracks(given[0], points=4, frames=5).all()


def test_points_missing_in_one_camera_may_be_seen_by_another():
    given = tracks()
    given[0, 3] = np.nan
    given[1, :, :, 0] = np.nan
    check_tracks(given, points=4, frames=5)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t[:, :4], "6 points over 4 frames are too few"),
        (lambda t: t[..., :3], "3 points over 8 frames are too few"),
        (lambda t: np.swapaxes(t, 2, 3), "expected"),
        (lambda t: np.where(np.arange(FRAMES)[:, None, None] == 6, np.nan, t), "In frame 6"),
        (lambda t: np.where(np.arange(POINTS) == 5, np.nan, t), "Point 5"),
    ],
)
def test_errors_state_the_required_numbers(spoil, message):
    with pytest.raises(MareyError, match=message):
        check_tracks(spoil(tracks()), points=4, frames=5)
