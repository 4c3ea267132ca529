"""Factorising arrays and files from Python: labels, round trip, and what is not written."""

import numpy as np
import pytest

from marey.errors import FileProblem, SettingProblem
from marey.geometry import rotations
from marey.pipelines.labelled import UnknownName
from marey.pipelines.nonrigid.factorise import factorise, read_tracks
from marey.pipelines.nonrigid.shapes import load_shapes

FRAMES, POINTS = 40, 9


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """Points (F, 3, P) of a cluster that rotates and deforms in one way."""
    rng, time = np.random.default_rng(3), np.arange(FRAMES)
    path = rotations.exp(np.stack([0.1 * np.sin(time / 15), np.ones(FRAMES), 0 * time], 1) * (0.08 * time)[:, None])
    mean, mode = 100 * rng.normal(size=(2, 3, POINTS))
    return path @ (mean + 0.3 * np.sin(time / 7)[:, None, None] * mode)


@pytest.fixture(scope="module")
def shapes(points):
    return factorise(points, basis_shapes=2, rate=50.0)


def test_points_in_space_are_placed_where_they_were_measured(shapes, points):
    # Coordinates reach some hundreds. A prior holds the shapes, so that the points are not reproduced exactly.
    np.testing.assert_allclose(shapes.placed, points, atol=3.0)
    assert shapes.kind == "points in space"
    assert shapes.rate == 50.0
    assert "9 of 9" in repr(shapes)


def test_points_are_found_by_label(shapes):
    place = shapes.points["3"]
    assert place.components == ("x", "y", "z")
    np.testing.assert_array_equal(place.values, shapes.shape[:, :, 3])
    with pytest.raises(UnknownName):
        shapes.points["nose"]


def test_what_is_saved_can_be_read_and_copied(shapes, tmp_path):
    out = shapes.save(tmp_path / "out")
    names = sorted(path.name for path in out.iterdir())
    assert names == ["report.html", "residuals.csv", "run.json", "shapes", "shapes.c3d", "shapes.glb", "shapes.npz"]
    read = load_shapes(out)
    np.testing.assert_array_equal(read.shape, shapes.shape)
    np.testing.assert_array_equal(read.shape_sd, shapes.shape_sd)
    assert read.labels == shapes.labels
    assert read.rate == shapes.rate
    assert read.details.settings["basis_shapes"] == 2
    assert str(read.summary()) == str(shapes.summary())
    assert sorted(path.name for path in read.save(tmp_path / "copy").iterdir()) == names
    with pytest.raises(FileProblem, match=r"no shapes\.npz"):
        load_shapes(tmp_path)


def test_an_xarray_has_units_and_labels(shapes):
    pytest.importorskip("xarray")
    arrays = shapes.to_xarray()
    assert arrays["shape"].attrs["units"] == shapes.unit
    np.testing.assert_array_equal(arrays["shape"].sel(point="3").values, shapes.shape[:, :, 3])


def test_a_file_and_its_tracks_give_the_same_shapes(points, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "cluster.npz", points=points, labels=[f"skin_{n}" for n in range(POINTS)], rate=50.0)
    from_file = factorise("cluster.npz", basis_shapes=2)
    from_tracks = factorise(read_tracks("cluster.npz"), basis_shapes=2)
    np.testing.assert_array_equal(from_file.shape, from_tracks.shape)
    assert from_tracks.labels[0] == "skin_0"
    assert read_tracks("cluster.npz", only=["skin_1", "skin_2"]).labels == ("skin_1", "skin_2")
    assert [path.name for path in tmp_path.iterdir()] == ["cluster.npz"]


def test_an_array_of_another_shape_is_an_error():
    with pytest.raises(FileProblem, match="shape"):
        factorise(np.zeros((5, 4)))
    with pytest.raises(SettingProblem, match="points in space"):
        factorise(np.zeros((5, 3, 9)), scaled=True)
