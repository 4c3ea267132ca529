"""Reading markers from C3D, TRC and CSV in metres, with gaps, and errors for invalid files."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from marey.errors import FileProblem, MareyError
from marey.io.markers.readers import read_markers
from marey.io.opensim.trc import PointPaths, write_trc


def c3d_of(path: Path, labels: list[str], points_mm, unit: str = "mm", rate: float = 100.0, residuals=None) -> Path:
    """Write a C3D with points (F, M, 3) and residuals (F, M) in the given unit."""
    points = np.asarray(points_mm, float)
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [rate]
    c3d["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = labels
    c3d["data"]["points"] = np.ones((4, points.shape[1], len(points)))
    c3d["data"]["points"][:3] = points.transpose(2, 1, 0)
    if residuals is not None:
        c3d["data"]["meta_points"]["residuals"] = np.asarray(residuals, float).T[None]
        c3d["data"]["meta_points"]["camera_masks"] = np.zeros((7, points.shape[1], len(points)), bool)
    c3d.write(str(path))
    return path


@pytest.fixture
def cloud(rng) -> np.ndarray:
    return rng.uniform(200, 900, (6, 4, 3))


def test_points_of_a_c3d_are_in_metres_and_zeros_and_negative_residuals_are_gaps(tmp_path, cloud):
    cloud[2, 1] = 0
    residuals = np.full((6, 4), 2.0)
    residuals[4, 3] = -1
    markers = read_markers(c3d_of(tmp_path / "a.c3d", list("abcd"), cloud, residuals=residuals))
    missing = np.zeros((6, 4), bool)
    missing[2, 1] = missing[4, 3] = True
    np.testing.assert_array_equal(~markers.present, missing)
    np.testing.assert_allclose(markers.points[~missing], cloud[~missing] * 1e-3, atol=1e-7)
    np.testing.assert_array_equal(np.isnan(markers.residuals), missing)
    np.testing.assert_allclose(markers.residuals[~missing], 2e-3, rtol=1e-6)
    assert not markers.filled.any()


def test_a_trc_keeps_its_own_axes(tmp_path):
    path = tmp_path / "a.trc"
    points = np.array([[[1.0, 2.0, 3.0], [1.5, 2.0, 3.0]]] * 3)
    write_trc(path, PointPaths(names=("a", "b"), time=[0.5, 0.51, 0.52], rate=100, points=points))
    markers = read_markers(path)
    np.testing.assert_allclose(markers.points, points[..., [1, 2, 0]])  # write_trc uses the axes of OpenSim
    assert (markers.rate, markers.start_s) == (100, 0.5)


def test_different_rates_in_header_and_times_are_reported(tmp_path):
    path = tmp_path / "a.trc"
    points = np.array([[[1.0, 2.0, 3.0], [1.5, 2.0, 3.0]]] * 3)
    write_trc(path, PointPaths(names=("a", "b"), time=[0, 0.02, 0.04], rate=100, points=points))
    markers = read_markers(path)
    assert markers.rate == pytest.approx(50)
    assert "100 Hz" in markers.notes[0]


def test_a_trc_that_lacks_a_frame_is_rejected(tmp_path):
    path = tmp_path / "a.trc"
    points = np.array([[[1.0, 2.0, 3.0], [1.5, 2.0, 3.0]]] * 4)
    write_trc(path, PointPaths(names=("a", "b"), time=[0, 0.01, 0.03, 0.04], rate=100, points=points))
    with pytest.raises(FileProblem, match="not equidistant"):
        read_markers(path)


def test_the_prefix_of_a_subject_is_removed_and_reported(tmp_path, cloud):
    markers = read_markers(c3d_of(tmp_path / "a.c3d", ["Ann:a", "Ann:b", "Ann:c", "*110"], cloud))
    assert markers.labels == ("a", "b", "c", "*110")
    assert any("Ann" in note for note in markers.notes)


def test_prefixes_of_two_subjects_are_kept(tmp_path, cloud):
    labels = ["Ann:a", "Bob:a", "Ann:b", "Bob:b"]
    assert read_markers(c3d_of(tmp_path / "a.c3d", labels, cloud)).labels == tuple(labels)


def test_two_trajectories_with_the_same_label_are_skipped_unless_one_is_empty(tmp_path, cloud):
    both = read_markers(c3d_of(tmp_path / "a.c3d", ["a", "b", "a", "c"], cloud))
    assert both.labels == ("b", "c")
    assert any("label a" in note for note in both.notes)
    cloud[:, 0] = 0
    one = read_markers(c3d_of(tmp_path / "b.c3d", ["a", "b", "a", "c"], cloud))
    assert one.labels == ("b", "a", "c")
    np.testing.assert_allclose(one.points[:, 1], cloud[:, 2] * 1e-3, atol=1e-7)


@pytest.mark.parametrize(("unit", "looks"), [("m", "mm"), ("mm", "m")])
def test_an_impossible_unit_is_an_error_that_names_the_likely_one(tmp_path, cloud, unit: str, looks: str):
    values = cloud if looks == "mm" else cloud * 1e-3
    with pytest.raises(FileProblem, match=rf"unit is {unit}.*look like.*{looks}"):
        read_markers(c3d_of(tmp_path / "a.c3d", list("abcd"), values, unit))
    right = read_markers(tmp_path / "a.c3d", unit=looks)
    np.testing.assert_allclose(right.points, cloud * 1e-3, rtol=1e-6)


def test_files_without_markers_are_rejected(tmp_path, cloud):
    with pytest.raises(FileProblem, match="no measured point"):
        read_markers(c3d_of(tmp_path / "zeros.c3d", list("abcd"), cloud * 0))
    empty = c3d_of(tmp_path / "empty.c3d", [], np.zeros((5, 0, 3)))
    with pytest.raises(FileProblem, match="has no"):
        read_markers(empty)
    with pytest.raises(FileProblem, match="Give a C3D"):
        read_markers(tmp_path / "a.mp4")
    with pytest.raises(MareyError, match="inch"):
        read_markers(empty, unit="inch")


@pytest.mark.parametrize("length", [0, 3, 513, 700, 1500, -1])
def test_a_truncated_c3d_is_rejected(tmp_path, cloud, length: int):
    whole = c3d_of(tmp_path / "whole.c3d", list("abcd"), np.concatenate([cloud] * 30)).read_bytes()
    path = tmp_path / "cut.c3d"
    path.write_bytes(whole[:length] if length >= 0 else whole[:-600])
    with pytest.raises(FileProblem, match=r"ends before|too short|cannot be read"):
        read_markers(path)


def test_a_file_that_is_not_a_c3d_is_rejected(tmp_path):
    path = tmp_path / "a.c3d"
    path.write_bytes(b"hello" * 500)
    with pytest.raises(FileProblem, match="second byte"):
        read_markers(path)


def test_the_unit_of_a_csv_is_read_from_its_columns(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time_s,a_x_mm,a_y_mm,a_z_mm,b_2_x_mm,b_2_y_mm,b_2_z_mm\n1.0,1,2,3,400,5,6\n1.1,7,8,9,,,\n")
    markers = read_markers(path)
    assert markers.labels == ("a", "b_2")
    assert (round(markers.rate, 9), markers.start_s) == (10, 1)
    np.testing.assert_allclose(markers.points[0], [[1e-3, 2e-3, 3e-3], [0.4, 5e-3, 6e-3]])
    assert not markers.present[1, 1]


def test_the_unit_of_a_csv_is_inferred_from_the_size_of_a_body_and_reported(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time;a.X;a.Y;a.Z;b.X;b.Y;b.Z\n0;0.1;0;0;0.9;0;0\n0.01;0.1;0;0;0.9;0;0\n")
    markers = read_markers(path)
    np.testing.assert_allclose(markers.points[0, :, 0], [0.1, 0.9])
    assert "so m is assumed" in markers.notes[0]


def test_a_vicon_csv_is_read(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "Trajectories\n200\n,,Ann:a,,,Ann:b,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n"
        "11,0,1,2,3,400,5,6\n12,0,1,2,3,,,\n"
    )
    markers = read_markers(path)
    assert (markers.labels, markers.rate, markers.start_s) == (("a", "b"), 200, 0.05)
    np.testing.assert_allclose(markers.points[0, 1], [0.4, 5e-3, 6e-3])
    assert not markers.present[1, 1]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("time,a,b\n0,1,2\n", "no columns of markers"),
        ("a_x_mm,a_y_mm,a_z_mm\n1,2,3\n", "no column of times"),
        ("time,a_x_mm,a_y_mm,a_z_mm\n0,1,2,3\n0.1,1,2,3\n0.5,1,2,3\n", "not equidistant"),
        ("time,a_x_mm,a_y_m,a_z_mm\n0,1,2,3\n", "mixes"),
        ("time,a_x,a_y,a_z,a_x\n0,1,2,3,4\n", "a_x twice"),
        ("time,a_x_mm,a_y_mm,a_z_mm\n0,one,2,3\n1,1,2,3\n", "not a number"),
    ],
)
def test_an_invalid_csv_is_an_error_that_states_the_problem(tmp_path, text: str, wrong: str):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(FileProblem, match=wrong):
        read_markers(path)


def test_real_files_give_their_clusters(shared):
    from marey.markers.data.labels import clusters_from_names, find_clusters

    folder = shared / "data" / "markers"
    walk = read_markers(folder / "sta" / "lmam_treadmill_walking.c3d")
    assert [(c.segment, len(c.labels)) for c in find_clusters(walk.labels).clusters] == [("thigh", 35), ("shank", 26)]
    knee = read_markers(folder / "functional" / "knee_dense.trc")
    assert len(clusters_from_names({"knee": ("*",)}, knee.labels).clusters[0].labels) == 71
