"""Faults of given tracks: planted ones are named with their repair, sound tracks have none."""

import numpy as np
import pytest

import marey
from marey.geometry import rotations
from marey.pipelines.causes.tracks import track_reasons

FRAMES, POINTS = 40, 9
LABELS = [f"p{k}" for k in range(POINTS)]


@pytest.fixture(scope="module")
def points():
    """A cloud that turns and deforms, (40, 3, 9), away from the origin [mm]."""
    rng, when = np.random.default_rng(3), np.arange(FRAMES)
    path = rotations.exp(np.outer(0.05 * when, [0.1, 1.0, 0.0]))
    mean, mode = 100 * rng.normal(size=(2, 3, POINTS))
    made = path @ (mean + 0.3 * np.sin(when / 7)[:, None, None] * mode) + 400.0
    return made + rng.normal(scale=0.2, size=made.shape)


def causes(points, **more):
    return [reason.cause for reason in track_reasons(points, np.arange(len(points)), LABELS, **more)]


def test_sound_tracks_have_no_fault(points):
    assert causes(points) == []
    rng = np.random.default_rng(0)
    missing = np.where(rng.random((FRAMES, 1, POINTS)) < 0.1, np.nan, points)
    assert causes(missing) == []
    assert causes(np.concatenate([points[:, :2], points[:, 1:]], 1), views=2) == []
    assert causes(points[:3]) == []


def test_a_point_at_the_origin_is_not_missing(points):
    still = points.copy()
    still[:, :, 0] = 0.0
    assert causes(still) == []
    through = points - points[20, :, :1]
    assert causes(through) == []


def test_missing_places_that_were_written_as_zeros_are_counted(points):
    gone = np.random.default_rng(1).random((FRAMES, POINTS)) < 0.05
    [reason] = track_reasons(np.where(gone[:, None], 0.0, points), np.arange(FRAMES), LABELS)
    assert (reason.cause, reason.level) == ("zeros", "not usable")
    assert reason.what.startswith(f"{gone.sum()} places of")
    one = points.copy()
    one[11, :, 4] = 0.0
    [reason] = track_reasons(one, np.arange(FRAMES), LABELS)
    assert (reason.cause, reason.level) == ("zeros", "usable with limits")
    assert reason.what.startswith("1 place of the points p4:")


def test_exchanged_tracks_are_named_with_the_frame(points):
    wrong = points.copy()
    wrong[17:, :, [2, 5]] = wrong[17:, :, [5, 2]]
    [reason] = track_reasons(wrong, np.arange(100, 100 + FRAMES), LABELS, unit="mm")
    assert reason.cause == "exchanged tracks"
    assert "p2" in reason.what
    assert "p5" in reason.what
    assert "from frame 117 on" in reason.what


def test_frames_out_of_order_are_named(points):
    wrong = points.copy()
    wrong[[12, 30]] = wrong[[30, 12]]
    [reason] = track_reasons(wrong, np.arange(FRAMES), LABELS)
    assert reason.cause == "order of frames"
    assert reason.what.startswith("Frames 12, 30:")
    by_name = np.argsort([str(n) for n in range(FRAMES)])
    [reason] = track_reasons(points[by_name], np.arange(FRAMES), LABELS)
    assert "1, 10, 11, 2" in reason.what
    assert reason.level == "not usable"


def test_tracks_exchanged_among_frames_out_of_order_are_named_with_the_frame_of_the_input(points):
    wrong = points.copy()
    wrong[17:, :, [2, 5]] = wrong[17:, :, [5, 2]]
    by_name = np.argsort([str(n) for n in range(FRAMES)])
    found = track_reasons(wrong[by_name], np.arange(FRAMES), LABELS)
    assert [reason.cause for reason in found] == ["order of frames", "exchanged tracks"]
    assert f"from frame {by_name.tolist().index(17)} on" in found[1].what


def test_repeated_frames_are_named(points):
    wrong = points.copy()
    wrong[9] = wrong[8]
    [reason] = track_reasons(wrong, np.arange(FRAMES), LABELS)
    assert reason.cause == "repeated frames"
    assert reason.what.startswith("Frame 9:")


def test_the_verdict_of_the_shapes_states_the_cause(points):
    wrong = points.copy()
    wrong[17:, :, [2, 5]] = wrong[17:, :, [5, 2]]
    shapes = marey.factorise(wrong, basis_shapes=2, progress=marey.RecordingProgress())
    assert "exchanged tracks" in [reason.cause for reason in shapes.verdict.reasons]
