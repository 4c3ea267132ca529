"""The comparison of two motions: names, figures, files, and conversions."""

import csv
import json

import numpy as np
import pytest
from tests import performer

from marey.errors import FileProblem, SettingProblem
from marey.io.npz import write_motion
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.motion.names import hinge_sign, known_angle, known_point, known_segment
from marey.pipelines.capture.motion import Motion
from marey.pipelines.compare import compare
from marey.pipelines.labelled import UnknownName

TIME = np.arange(0, 4, 0.01)


def knee(time: np.ndarray) -> np.ndarray:
    return 35 - 30 * np.cos(5 * time) + 5 * np.sin(11 * time) + 3 * time


@pytest.fixture
def files(tmp_path):
    for name, values in (("a", knee(TIME)), ("b", knee(TIME) + 4)):
        table = TimeSeriesTable(name=name, columns=("left_knee_flexion",), time=TIME, values=values[:, None])
        write_table(tmp_path / f"{name}.mot", table)
    return tmp_path


def test_a_comparison_lists_its_quantities_and_describes_itself(files):
    found = compare(files / "a.mot", files / "b.mot")
    assert found.names == ("left_knee_flexion",)
    assert np.degrees(found["left knee flexion"].bias) == pytest.approx(-4, abs=1e-3)
    assert found["left knee flexion"].unit == "rad"
    assert repr(found).startswith("Comparison of a and b\n  frames      400 in common, 3.99 s")
    with pytest.raises(UnknownName, match="left knee flexion"):
        found["right knee flexion"]


def test_a_comparison_is_saved_with_its_record(files):
    found = compare(files / "a.mot", files / "b.mot", shift=0.0)
    out = found.save(files / "both")
    assert sorted(path.name for path in out.iterdir()) == ["compare.csv", "report.html", "run.json"]
    record = json.loads((out / "run.json").read_text())
    assert record["settings"]["shift_s"] == 0.0
    assert len(record["inputs"]) == 2


def test_the_table_is_that_of_the_file(files):
    pytest.importorskip("pandas")
    found = compare(files / "a.mot", files / "b.mot")
    table = found.to_pandas()
    with (found.save(files / "both") / "compare.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert table.index.tolist() == [row["quantity"]]
    for name in ("rms", "bias", "limit_low", "correlation"):
        assert table[name].iloc[0] == pytest.approx(float(row[name]), abs=1e-5)


def test_both_curves_of_an_angle_are_drawn(files):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    axes = compare(files / "a.mot", files / "b.mot").plot("left knee flexion")
    assert [line.get_label() for line in axes.lines] == ["a", "b"]


def test_motions_in_memory_are_compared(tmp_path):
    data = performer.motion(performer.body())
    write_motion(tmp_path / "motion.npz", data)
    found = compare(Motion(data), tmp_path / "motion.npz", shift=0.0, same_laboratory=True)
    assert max(row.rms for row in found.data.agreements) == pytest.approx(0, abs=1e-6)
    assert found.labels[0] == "motion"


def test_names_are_given_as_a_mapping(files):
    write_table(files / "c.mot", TimeSeriesTable(name="c", columns=("Knie",), time=TIME, values=-knee(TIME)[:, None]))
    with pytest.raises(FileProblem, match="no angle, point or segment of the same name"):
        compare(files / "a.mot", files / "c.mot")
    found = compare(files / "a.mot", files / "c.mot", names={"angles": {"left_knee_flexion": "-Knie"}})
    assert found["left knee flexion"].rms < 1e-4


def test_known_names_of_other_programs_are_ours():
    assert known_angle("knee_angle_l") == ("left_knee_flexion", 1.0)
    assert known_angle("lumbar_extension") == ("trunk_flexion", -1.0)
    assert known_angle("subtalar_angle_r") is None
    names = ("RKnee", "R_KJC", "RightKneeCenter", "knee_r", "right_knee", "RKJC")
    assert {known_point(name) for name in names} == {"right_knee"}
    assert known_point("R.Knee.Lat") is None
    assert (known_segment("femur_l"), known_segment("torso")) == ("left_thigh", "thorax")


def test_a_knee_that_bends_below_zero_is_turned_round():
    assert hinge_sign("left_knee_flexion", np.radians([-60, -30, 2.0])) == -1
    assert hinge_sign("left_knee_flexion", np.radians([60, 30, -4.0])) == 1
    assert hinge_sign("left_hip_flexion", np.radians([-60, -30, 2.0])) == 1


def test_the_rate_of_a_second_clock_is_estimated_with_its_offset(tmp_path):
    time = np.arange(0, 12, 0.01)
    path = knee(time) + 9 * np.sin(0.9 * time**1.4)
    noise = 0.3 * np.random.default_rng(1).standard_normal((2, len(time)))
    for name, times, values in (("a", time, path + noise[0]), ("b", (time - 0.3) / 1.004, path + noise[1])):
        kept = times >= 0
        table = TimeSeriesTable(
            name=name, columns=("left_knee_flexion",), time=times[kept], values=values[kept, None]
        )  # fmt: skip
        write_table(tmp_path / f"{name}.mot", table)
    found = compare(tmp_path / "a.mot", tmp_path / "b.mot", clock="rate")
    clock = found.data.clock
    assert abs(clock.drift - 0.004) < 3 * clock.drift_sd < 0.002
    assert abs(clock.offset_s - 0.3) < 3 * clock.offset_sd_s < 0.01
    assert np.degrees(found["left knee flexion"].rms) < 0.6


def test_a_clock_that_is_unknown_or_not_determined_is_a_problem(files):
    with pytest.raises(SettingProblem, match="offset, rate"):
        compare(files / "a.mot", files / "b.mot", clock="drift")
    with pytest.raises(FileProblem, match=r"no time in common at a shift of 99.000 s\). Give another shift"):
        compare(files / "a.mot", files / "b.mot", shift=99.0)
    with pytest.raises(SettingProblem, match=r"shift \(--shift\) is nan"):
        compare(files / "a.mot", files / "b.mot", shift=float("nan"))
    with pytest.raises(SettingProblem, match="--shift"):
        compare(files / "a.mot", files / "b.mot", clock="rate", shift=0.0)
    table = TimeSeriesTable(name="c", columns=("left_knee_flexion",), time=TIME, values=np.sin(9 * TIME)[:, None])
    write_table(files / "c.mot", table)
    with pytest.raises(FileProblem, match="periodic"):
        compare(files / "c.mot", files / "c.mot", clock="rate")
