"""Roll and scale of two cameras from tracks alone, and placement of a camera before known points."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.nonrigid.many_cameras.view_geometry import place_camera, rows_of, view_pair

FRAMES, POINTS = 12, 9


@pytest.fixture
def seen(rng):
    """Points that move anyhow, and what two scaled cameras show of them: camera from points, points, tracks."""
    points = rng.normal(size=(FRAMES, 3, POINTS))
    cameras = rotations.exp(rng.normal(size=(2, 3)))
    rows = rows_of(cameras, np.array([1.0, 1.7]))
    tracks = (rows @ points).reshape(FRAMES, 2, 2, POINTS).swapaxes(0, 1) + rng.normal(size=(2, FRAMES, 2, 1))
    return cameras, points, tracks


def test_two_cameras_determine_all_but_the_angle_between_their_lines_of_sight(seen):
    cameras, _, tracks = seen
    pair = view_pair(*tracks)
    relative = cameras[1] @ cameras[0].T
    angle = np.arccos(relative[2, 2])
    wrong = [np.linalg.norm(rotations.log(pair.second_from_first(sign * angle) @ relative.T)) for sign in (1, -1)]
    assert min(wrong) < 1e-6
    assert pair.scale == pytest.approx(1.7)
    assert pair.spread[0] < 1e-6  # the root of rounding
    assert not pair.outlying.any()


def test_too_few_common_frames_give_no_pair(seen):
    tracks = seen[2].copy()
    tracks[1, 5:] = np.nan
    assert view_pair(*tracks) is None


def test_a_camera_is_placed_before_known_points_with_gaps(seen, rng):
    cameras, points, tracks = seen
    tracks = np.where(rng.random((FRAMES, 1, POINTS)) < 0.2, np.nan, tracks[1])
    rotation, scale = place_camera(tracks, points)
    np.testing.assert_allclose(rotation, cameras[1], atol=1e-9)
    assert scale == pytest.approx(1.7)
    assert place_camera(tracks[:5], points[:5]) is None
