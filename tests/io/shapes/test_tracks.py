import numpy as np
import pytest

from marey.errors import FileProblem
from marey.images.matching.feature_tracks import FeatureTracks
from marey.io.npz import read_arrays
from marey.io.shapes.tracks import read_points, write_tracks

FITS = {"frames": 10, "size": (640, 480)}


def test_written_tracks_are_read(tmp_path):
    rng = np.random.default_rng(0)
    visible = rng.random((5, 7)) < 0.5
    tracks = FeatureTracks(
        tracks=rng.random((5, 2, 7)), tracks_sd=rng.random((5, 2, 7)), visible=visible, predicted=~visible
    )
    write_tracks(tmp_path / "tracks.npz", tracks)
    again = read_arrays(tmp_path / "tracks.npz")
    assert set(again) == {"tracks", "tracks_sd", "visible", "predicted"}
    for name, array in again.items():
        assert np.array_equal(array, getattr(tracks, name))


def test_points_and_their_frame_are_read(tmp_path):
    np.savez(tmp_path / "points.npz", points=[[1, 2], [639, 479]], frame=3)
    points, frame = read_points(tmp_path / "points.npz", **FITS)
    assert np.array_equal(points, [[1.0, 2.0], [639.0, 479.0]])
    assert frame == 3


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": [[1, 2]]}, "lacks frame"),
        ({"points": [[1, 2, 3]], "frame": 0}, "shape"),
        ({"points": [["a", "b"]], "frame": 0}, "type"),
        ({"points": [[1, 2]], "frame": 10}, "frames 0 to 9"),
        ({"points": [[1, 2]], "frame": 1.5}, "whole number"),
        ({"points": [[1, 2], [640, 5]], "frame": 0}, "point 1 at"),
        ({"points": [[np.nan, 2]], "frame": 0}, "point 0 at"),
    ],
)
def test_points_that_cannot_be_tracked_are_rejected(tmp_path, arrays, message):
    np.savez(tmp_path / "points.npz", **arrays)
    with pytest.raises(FileProblem, match=message):
        read_points(tmp_path / "points.npz", **FITS)
