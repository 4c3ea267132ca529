"""Tracks and points that a user has already."""

import numpy as np
import pytest

from marey.errors import FileProblem, SettingProblem
from marey.io.shapes.deforming_points import read_deforming, with_labels


def test_tracks_of_one_view_are_read_as_one_camera(tmp_path, rng):
    tracks = rng.normal(size=(7, 2, 5))
    tracks[3, 0, 1] = np.nan
    np.savez(tmp_path / "a.npz", tracks=tracks.astype(np.float32), tracks_sd=np.ones(tracks.shape), rate=25)
    read = read_deforming(tmp_path / "a.npz")
    assert read.tracks.shape == (1, 7, 2, 5)
    assert np.isnan(read.tracks[0, 3, :, 1]).all()
    assert read.rate == 25
    assert read.labels == ("0", "1", "2", "3", "4")
    assert read.notes == ("1 positions have an incomplete set of coordinates and are treated as missing.",)


def test_places_that_were_predicted_count_as_not_seen(tmp_path, rng):
    predicted = rng.random((7, 5)) < 0.3
    np.savez(tmp_path / "a.npz", tracks=rng.normal(size=(7, 2, 5)), predicted=predicted, visible=~predicted)
    read = read_deforming(tmp_path / "a.npz")
    np.testing.assert_array_equal(np.isnan(read.tracks[0, :, 0]), predicted)
    np.savez(tmp_path / "b.npz", tracks=rng.normal(size=(7, 2, 5)), predicted=predicted[1:])
    with pytest.raises(FileProblem, match=r"predicted of shape \(6, 5\)"):
        read_deforming(tmp_path / "b.npz")


def test_points_in_space_are_read_point_by_point(tmp_path, rng):
    points = rng.normal(size=(7, 3, 5))
    np.savez(tmp_path / "a.npz", points=points, labels=list("abcde"), edges=[[0, 4]], note="a note")
    read = read_deforming(tmp_path / "a.npz")
    np.testing.assert_array_equal(read.points, np.moveaxis(points, 1, 2))
    assert read.labels == tuple("abcde")
    assert read.edges.tolist() == [[0, 4]]
    assert read.notes == ("Ignored arrays of a.npz: note.",)


def test_points_are_selected_by_their_labels(tmp_path, rng):
    labels = ["thigh_1", "shank_1", "thigh_2", "heel"]
    np.savez(tmp_path / "a.npz", points=rng.normal(size=(7, 3, 4)), labels=labels, edges=[[0, 2], [1, 3], [2, 3]])
    read = read_deforming(tmp_path / "a.npz")
    kept = with_labels(read, ["thigh_*", "heel"])
    assert kept.labels == ("thigh_1", "thigh_2", "heel")
    np.testing.assert_array_equal(kept.points, read.points[:, [0, 2, 3]])
    assert kept.edges.tolist() == [[0, 1], [1, 2]]
    with pytest.raises(SettingProblem, match=r"\(--only\) has foot\*, which matches no point\. The points are thigh_1"):
        with_labels(read, ["heel", "foot*"])


def test_a_damaged_file_is_named(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK no zip")
    with pytest.raises(FileProblem, match=r"a\.npz"):
        read_deforming(tmp_path / "a.npz")
