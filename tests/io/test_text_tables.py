"""TRC, MOT and STO files are read as written, with gaps and axes; invalid files are errors that state the problem."""

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.opensim.mot_sto import (
    Orientations,
    TimeSeriesTable,
    read_orientations,
    read_table,
    write_orientations,
    write_table,
)
from marey.io.opensim.trc import PointPaths, read_trc, write_trc
from marey.motion.motion import BodyMotion

TRC = "PathFileType\t4\nDataRate\tNumFrames\tNumMarkers\tUnits\n30\t{frames}\t{markers}\tm\nFrame#\tTime\ta\n\n"
TRC += "1\t0\t1\t2\t3\n2\t0.1\t1\t2\t3\n"
"""A TRC of one marker and two frames, whose header may state others."""


def test_a_trc_is_read_as_written_with_gaps(motion: BodyMotion, tmp_path):
    path = tmp_path / "joint_centres.trc"
    write_trc(path, PointPaths(names=motion.joint_names, time=motion.time, rate=30, points=motion.joint_centres))
    back = read_trc(path)
    assert back.names == motion.joint_names
    assert back.rate == 30
    np.testing.assert_allclose(back.points, motion.joint_centres, atol=0.5e-7)
    np.testing.assert_allclose(back.time, motion.time, atol=0.5e-6)


def test_a_trc_is_in_opensims_axes(tmp_path):
    path = tmp_path / "p.trc"
    write_trc(path, PointPaths(names=("a",), time=[0.0], rate=50, points=[[[1.0, 2.0, 3.0]]]))
    last = path.read_text().splitlines()[-1].split("\t")
    assert [float(v) for v in last] == [1, 0, 2, 3, 1]


def test_a_trc_in_millimetres_with_empty_cells_is_read(tmp_path):
    path = tmp_path / "p.trc"
    write_trc(path, PointPaths(names=("a", "b"), time=[0.0], rate=50, points=[[[1.0, 2.0, 3.0]] * 2]))
    text = path.read_text().replace("\tm\t", "\tmm\t").splitlines()
    text[-1] = "1\t0.0\t2000\t3000\t1000\t\t\t"
    path.write_text("\n".join(text) + "\n")
    np.testing.assert_allclose(read_trc(path).points, [[[1, 2, 3], [np.nan] * 3]])


def test_a_table_is_read_as_written_with_gaps(motion: BodyMotion, tmp_path):
    path = tmp_path / "angles.mot"
    values = np.degrees(motion.coordinates)
    write_table(path, TimeSeriesTable(name="angles", columns=motion.coordinate_names, time=motion.time, values=values))
    back = read_table(path)
    assert (back.columns, back.in_degrees, back.name) == (motion.coordinate_names, True, "angles")
    np.testing.assert_allclose(back.values, values, atol=0.5e-8)


def test_orientations_are_read_as_written_with_gaps(motion: BodyMotion, tmp_path):
    path = tmp_path / "orientations.sto"
    names, turn = motion.segment_names, motion.segment_rotation
    write_orientations(path, Orientations(names=names, time=motion.time, rate=30.0, world_from_body=turn))
    back = read_orientations(path)
    assert (back.names, back.rate) == (names, 30)
    np.testing.assert_allclose(back.world_from_body, turn, atol=4e-9)


@pytest.mark.parametrize(
    ("read", "text", "wrong"),
    [
        (read_trc, "nonsense", "PathFileType"),
        (read_trc, "PathFileType\t4\nDataRate\tUnits\n30\tfoot\nFrame#\tTime\ta\n\n", "'foot'"),
        (read_table, "time\ta\n0\t1\n", "endheader"),
        (read_table, "x\nendheader\nframe\ta\n0\t1\n", "'frame'"),
        (read_table, "x\nendheader\ntime\ta\n0\tone\n", "damaged"),
        (read_orientations, "x\nendheader\ntime\ta\n0\t1,0,0\n", "damaged"),
        (read_trc, TRC.format(frames=3, markers=1), "states NumFrames 3, but has 2"),
        (read_trc, TRC.format(frames=2, markers=9), "states NumMarkers 9, but has 1"),
        (read_trc, TRC.format(frames="two", markers=1), "has NumFrames 'two'"),
        (read_table, "x\nnRows=2\nendheader\ntime\ta\n0\t1\n", "states nRows 2, but has 1"),
        (read_table, "x\nnColumns=" + 30 * "9" + "\nendheader\ntime\ta\n0\t1\n", "states nColumns 9999"),
        (read_table, "x\ninDegrees=perhaps\nendheader\ntime\ta\n0\t1\n", "has inDegrees=perhaps"),
        (read_orientations, "DataRate=x\nendheader\ntime\ta\n0\t1,0,0,0\n", "no valid rate"),
    ],
)
def test_an_invalid_file_is_an_error_that_states_the_problem(tmp_path, read, text: str, wrong: str):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(FileProblem, match=wrong) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_files_of_windows_are_read(tmp_path):
    """A byte order mark, and lines that end in CR and LF."""
    for read, text in (
        (read_trc, TRC.format(frames=2, markers=1)), (read_table, "x\nnRows=1\nendheader\ntime\ta\n0\t1\n"),
        (read_orientations, "DataRate=9\nendheader\ntime\ta\n0\t1,0,0,0\n"),
    ):  # fmt: skip
        (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
        assert len(read(tmp_path / "a.txt").time) in (1, 2)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "results" / "a.txt"
    with replacing(path) as beside:
        beside.write_text("old")
    with pytest.raises(ZeroDivisionError), replacing(path) as beside:
        beside.write_text(str(1 / 0))
    assert path.read_text() == "old"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("read", [read_table, read_orientations])
def test_an_empty_line_of_columns_is_a_missing_first_column(tmp_path, read):
    path = tmp_path / "a.sto"
    path.write_text("a\nendheader\n\n0\t1\n")
    with pytest.raises(FileProblem, match=r"a.sto: has the first column ''. The first column should be `time`"):
        read(path)
