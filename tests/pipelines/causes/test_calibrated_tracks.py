"""Tracks of several cameras that contradict the calibration: the planted fault is named, sound tracks have none."""

import numpy as np
import pytest
from tests import worlds

from marey.cameras.rig import Rig
from marey.pipelines.causes.calibrated_tracks import calibrated_track_reasons

RIG = Rig(worlds.ring(3))
FRAMES, POINTS = 30, 25


def seen(points: np.ndarray) -> np.ndarray:
    """Project points (F, P, 3) into all cameras: (C, F, 2, P) [px]."""
    return np.stack([np.moveaxis(camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2), 2, 1)
                     for camera in RIG])  # fmt: skip


@pytest.fixture(scope="module")
def tracks() -> np.ndarray:
    """A cloud that moves along a curve, with errors of 0.3 px, and places missing."""
    rng, when = np.random.default_rng(2), np.arange(FRAMES)[:, None, None]
    cloud = rng.uniform([-0.3, -0.3, 0.4], [0.3, 0.3, 1.6], (POINTS, 3))
    moved = cloud + 0.5 * np.concatenate([np.sin(when / 4), np.cos(when / 3), np.sin(when / 3) / 2], 2)
    places = seen(moved)
    places += rng.normal(0, 0.3, places.shape)
    return np.where(rng.random((3, FRAMES, 1, POINTS)) < 0.1, np.nan, places)


def cause(tracks: np.ndarray) -> tuple[str, tuple[str, ...]]:
    [reason] = calibrated_track_reasons(tracks, RIG)
    assert reason.level == "not usable"
    return reason.cause, reason.cameras


def test_sound_tracks_have_no_cause(tracks):
    assert calibrated_track_reasons(tracks, RIG) == ()
    assert calibrated_track_reasons(np.where(np.arange(3)[:, None, None, None] > 0, np.nan, tracks), RIG) == ()


def test_exchanged_files_are_named(tracks):
    assert cause(tracks[[1, 0, 2]]) == ("exchanged", (RIG.names[0], RIG.names[1]))


@pytest.mark.parametrize(("axis", "kind"), [(0, "mirrored"), (1, "upside down")])
def test_an_axis_that_points_the_other_way_is_named(tracks, axis, kind):
    wrong = tracks.copy()
    wrong[2, :, axis] = RIG.cameras[2].size[axis] - 1 - wrong[2, :, axis]
    assert cause(wrong) == (kind, (RIG.names[2],))


def test_a_camera_of_another_size_is_named(tracks):
    wrong = tracks.copy()
    wrong[1] *= 0.5
    assert cause(wrong) == ("image size", (RIG.names[1],))


def test_a_late_camera_is_named_with_its_frames(tracks):
    wrong = np.full_like(tracks, np.nan)
    wrong[:2], wrong[2, 4:] = tracks[:2], tracks[2, :-4]
    [reason] = calibrated_track_reasons(wrong, RIG)
    assert reason.cause == "late"
    assert reason.what.startswith(f"The tracks of {RIG.names[2]} are 4 frames late: shifted, ")


def test_points_of_another_recording_are_stated_without_a_cause(tracks):
    other = np.random.default_rng(8).uniform([-0.6, -0.6, 0.2], [0.6, 0.6, 1.8], (FRAMES, POINTS, 3))
    wrong = tracks.copy()
    wrong[0] = seen(other)[0]
    [reason] = calibrated_track_reasons(wrong, RIG)
    assert (reason.level, reason.cause) == ("not usable", "unexplained")
