"""From records of trials to the table, the means over subjects, and the differences between conditions."""

import numpy as np
import pytest

from marey.io.results.repetitions import write_repetitions
from marey.io.study.records import StepRecord, StepValue
from marey.io.study.trials import StudyTrial
from marey.motion.events.repetitions import Flight, Repetition, Repetitions
from marey.pipelines.study.quantities import NORMAL_95, quantities_of
from marey.pipelines.study.summary import PAIRED, UNPAIRED, mean_rows, study_rows, subject_rows


def trial(name: str) -> StudyTrial:
    subject, condition = name.split("/")
    return StudyTrial(name=name, path=None, subject=subject, condition=condition.split("_")[0])  # type: ignore[arg-type]


def record(value: float, sd: float = 0.1, verdict: str = "good") -> StepRecord:
    half = NORMAL_95 * sd
    own = StepValue(quantity="speed", side="both", unit="m/s", value=value, low=value - half, high=value + half)
    return StepRecord(state="done", key="", verdict=verdict, values=(own,))


def rows_of(values: dict[str, StepRecord]):
    return study_rows([trial(name) for name in values], {(name, "markers"): each for name, each in values.items()})


def test_a_subject_counts_once_however_many_trials_it_has(rng):
    values = {f"S{s}/slow_{k}": record(1.0 + s) for s in range(3) for k in range(1 + 5 * s)}
    (mean,) = mean_rows(rows_of(values))
    assert (mean.subjects, mean.trials, mean.minus, mean.kind) == (3, 18, "", "mean")
    # The more trials, the smaller the standard error of a subject, and the subjects differ far more than that.
    assert mean.mean == pytest.approx(2.0, abs=0.01)
    assert [row.trials for row in subject_rows(rows_of(values))] == [1, 6, 11]


def test_conditions_are_compared_within_subjects_where_both_are_known():
    slow = {f"S{s}/slow_1": record(1.0 + s) for s in range(4)}
    fast = {f"S{s}/fast_1": record(1.3 + s + 0.01 * s) for s in range(1, 5)}
    found = mean_rows(rows_of({**slow, **fast}), reference="slow")
    (difference,) = [row for row in found if row.minus]
    assert (difference.kind, difference.condition, difference.minus, difference.subjects) == (PAIRED, "fast", "slow", 3)
    assert difference.mean == pytest.approx(0.32)
    # Two conditions without a reference: the first in the order of their names is subtracted.
    (other,) = [row for row in mean_rows(rows_of({**slow, **fast})) if row.minus]
    assert (other.condition, other.mean) == ("slow", pytest.approx(-0.32))


def test_conditions_of_different_people_are_compared_by_their_means():
    values = {f"S{s}/slow_1": record(1.0 + 0.1 * s) for s in range(3)}
    values |= {f"P{s}/fast_1": record(2.0 + 0.1 * s) for s in range(3)}
    (difference,) = [row for row in mean_rows(rows_of(values), reference="slow") if row.minus]
    assert (difference.kind, difference.subjects) == (UNPAIRED, 6)
    assert difference.mean == pytest.approx(1.0)


def test_three_conditions_without_a_reference_are_not_compared():
    values = {f"S{s}/{name}_1": record(1.0) for s in range(3) for name in ("a", "b", "c")}
    assert [row.minus for row in mean_rows(rows_of(values))] == ["", "", ""]
    assert [row.minus for row in mean_rows(rows_of(values), reference="b")] == ["", "", "", "b", "b"]


def test_flags_name_outliers_limits_and_missing_intervals():
    values = {f"S{s}/slow_1": record(1.0 + 0.01 * s) for s in range(9)}
    values["S9/slow_1"] = record(9.0, sd=np.nan, verdict="usable with limits")
    rows = rows_of(values)
    assert {row.flags for row in rows[:9]} == {""}
    assert rows[9].flags == "outlier; usable with limits; no interval"


def test_values_that_are_not_usable_are_in_the_table_but_not_in_the_means():
    values = {"S1/slow_1": record(1.0), "S2/slow_1": record(50.0, verdict="not usable")}
    rows = rows_of(values)
    assert [row.flags for row in rows] == ["", "not usable"]
    assert [row.mean for row in mean_rows(rows)] == [1.0]


def test_repetitions_become_means_of_each_kind(tmp_path):
    squats = [
        Repetition(kind="squat", start_s=s, lowest_s=s + 1, end_s=s + 2, depth_m=depth, depth_sd_m=0.01)
        for s, depth in ((1.0, 0.3), (4.0, 0.4), (7.0, 0.5))
    ]
    flight = Flight(takeoff_s=10.5, landing_s=11.0, sd_s=0.01)
    jump = Repetition(kind="jump", start_s=10, lowest_s=10.2, end_s=11, depth_m=0.2, depth_sd_m=0.01, flight=flight)
    largest = np.array([[90.0], [100.0], [110.0], [60.0]])
    made = Repetitions(entries=(*squats, jump), angle_names=("left_knee_flexion",), largest_deg=largest)
    write_repetitions(tmp_path / "repetitions.csv", made)
    found = {(each.quantity, each.side): each for each in quantities_of(tmp_path)}
    assert found["squat_count", ""].value == 3
    depth = found["squat_depth", ""]
    assert (depth.value, depth.unit, depth.count) == (pytest.approx(0.4), "m", 3)
    # Student's t of two degrees of freedom times the standard error, and the common deviation of 0.01
    assert depth.high - depth.value == pytest.approx(np.hypot(4.302653 * 0.1 / np.sqrt(3), NORMAL_95 * 0.01), rel=1e-5)
    assert found["squat_knee_flexion_largest", "left"].value == pytest.approx(100)
    height = found["jump_height", ""]
    assert height.value == pytest.approx(flight.height_m, abs=1e-5)
    assert height.high - height.value == pytest.approx(NORMAL_95 * flight.height_sd_m, rel=1e-3)


def test_quantities_are_read_from_the_tables_of_a_command(tmp_path):
    (tmp_path / "gait.csv").write_text(
        "quantity,side,unit,value,between_cycles_sd,low95,high95,cycles\nspeed,both,m/s,1.2,,1.1,1.3,4\n"
    )
    (tmp_path / "angles.csv").write_text(
        "time_s,state,left_knee_flexion_deg,left_knee_flexion_sd_deg\n0,1,10,1\n1,0,99,1\n2,1,40,2\n3,1,,\n"
    )
    names = ["length", "girth_proximal", "girth_middle", "girth_distal", "volume", "mass"]
    units = ["m", "m", "m", "m", "l", "kg"]
    head = [part for n, u in zip(names, units, strict=True) for part in (f"{n}_{u}", f"{n}_sd_{u}")]
    (tmp_path / "segments.csv").write_text(
        f"segment,{','.join(head)},equal_by_model_to\n"
        f"left_thigh,0.4,0.01{',' * 10},right_thigh\nright_thigh,0.4,0.01{',' * 10},left_thigh\n"
    )
    found = {(v.quantity, v.side): v for v in quantities_of(tmp_path)}
    assert found["speed", "both"] == StepValue(
        quantity="speed", side="both", unit="m/s", value=1.2, low=1.1, high=1.3, count=4
    )
    high = found["knee_flexion_maximum", "left"]
    assert (high.value, high.high) == pytest.approx((40, 40 + 2 * NORMAL_95))
    assert found["knee_flexion_range", "left"].low == pytest.approx(30 - np.sqrt(5) * NORMAL_95)
    assert [key for key in found if key[0].startswith("thigh")] == [("thigh_length", "both")]
