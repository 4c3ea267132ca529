import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.devices.results import write_device_clock, write_device_signals
from marey.io.devices.signals import read_event_times, read_signals
from marey.io.markers.c3d import write_c3d
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.io.opensim.trc import PointPaths
from marey.motion.device_clock import DeviceClock

TIME = np.arange(40) / 100


def table(path, head, rows):
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("head", "unit"), [("time_ms", 1000), ("Timestamp (us)", 1e6), ("t", 1), ("time [s]", 1), ("time_s", 1)]
)
def test_times_of_a_table_are_in_the_unit_of_its_header(tmp_path, head, unit):
    rows = [f"{x};{unit * t:.6f};{'' if x == 3 else -x}" for x, t in enumerate(TIME)]
    found = read_signals(table(tmp_path / "imu.csv", f"gyro;{head};acc", rows))
    np.testing.assert_allclose(found.time, TIME, atol=1e-9)
    assert found.names == ("gyro", "acc")
    np.testing.assert_array_equal(found.values[:, 0], np.arange(40))
    assert np.isnan(found.values[3, 1])


def test_tables_of_opensim_are_read(tmp_path):
    values = np.random.default_rng(0).normal(size=(40, 2))
    write_table(tmp_path / "grf.sto", TimeSeriesTable(name="grf", columns=("a_vy", "b_vy"), time=TIME, values=values))
    found = read_signals(tmp_path / "grf.sto")
    assert found.names == ("a_vy", "b_vy")
    np.testing.assert_allclose(found.values, values, atol=1e-6)


ROWS = [f"{t},{k}" for k, t in enumerate(TIME)]


@pytest.mark.parametrize(
    ("head", "rows", "wrong"),
    [
        ("a,b", ROWS, "has no columns of times"),
        ("t,time", ROWS, "has 2 columns of times"),
        ("t,b", ROWS[:5], "has 5 samples"),
        ("t,b", [*ROWS, "0.1,2"], "has times that do not increase (after sample 40)"),
        ("t,b", [*ROWS[:3], "0.03,x"], "has 'x' in the column b, row 4"),
        ("t,b", [*ROWS, "0.9"], "has 1 cells in row 41"),
        ("t,b", [], "has no rows below a header"),
        ('t,"b', [*ROWS, '1,"'], "has a quotation mark that is not closed in its line"),
        ("t,b,b", [row + ",1" for row in ROWS], "has the signal b twice"),
        ("t", [row.split(",")[0] for row in ROWS], "has no signals"),
    ],
)
def test_a_wrong_table_is_named(tmp_path, head, rows, wrong):
    with pytest.raises(FileProblem) as caught:
        read_signals(table(tmp_path / "x.csv", head, rows))
    assert wrong in str(caught.value)
    assert "\n" not in str(caught.value)


def test_other_files_are_named(tmp_path):
    for name, wrong in (("a.wav", "is not a file of signals"), ("a.csv", "does not exist")):
        with pytest.raises(FileProblem, match=wrong):
            read_signals(tmp_path / name)
    paths = PointPaths(names=("a",), time=TIME, points=np.zeros((40, 1, 3)), rate=100.0)
    write_c3d(tmp_path / "points.c3d", paths)
    with pytest.raises(FileProblem, match="has no analog channels"):
        read_signals(tmp_path / "points.c3d")


def test_events_need_not_be_pairs(tmp_path):
    motion, device = read_event_times(table(tmp_path / "e.csv", "device_s,motion_s", ["1,2", "3,", ",4", "5,6"]))
    np.testing.assert_array_equal(motion, [2, 4, 6])
    np.testing.assert_array_equal(device, [1, 3, 5])
    with pytest.raises(FileProblem, match="has the columns a, b"):
        read_event_times(table(tmp_path / "f.csv", "a,b", ["1,2"]))


def test_results_are_readable(tmp_path):
    values, variance = np.array([[1.5, np.nan], [2.5, 4.0]]), np.array([[0.25, np.nan], [0.25, 1.0]])
    write_device_signals(tmp_path / "signals.csv", np.array([0.0, 0.1]), ("a", "b"), values, variance)
    assert (tmp_path / "signals.csv").read_text().splitlines() == [
        "time,a,a_sd,b,b_sd", "0.000000,1.5,0.5,,", "0.100000,2.5,0.5,4,1",
    ]  # fmt: skip
    clock = DeviceClock(offset_s=0.5, drift=1e-4, covariance=np.diag([1e-4, 1e-10]), used=9)
    write_device_clock(tmp_path / "clock.json", clock, method="events")
    assert '"drift_ppm": 100.0' in (tmp_path / "clock.json").read_text()
