"""Files of different programs are compared, and errors on input that does not fit."""

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.io.npz import write_arrays
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.io.opensim.trc import PointPaths, write_trc
from marey.pipelines.compare import compare

SHIFT = 0.25
TIME = np.arange(0, 4, 0.01)


def knee(time):
    return 35 - 30 * np.cos(5 * time) + 5 * np.sin(11 * time) + 3 * time


def hip(time):
    return 20 * np.cos(5 * time + 0.3) + time**2


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    time = np.arange(0.5, 5, 1 / 60)
    own = np.stack([knee(TIME), hip(TIME)], 1)
    other = np.stack([-knee(time - SHIFT), hip(time - SHIFT) + 4, 0 * time + 0.9], 1)
    names = ("right_knee_flexion", "right_hip_flexion")
    write_table(tmp_path / "ours.mot", TimeSeriesTable(name="a", columns=names, time=TIME, values=own))
    theirs = ("knee_angle_r", "hip_flexion_r", "pelvis_ty")
    write_table(tmp_path / "theirs.mot", TimeSeriesTable(name="b", columns=theirs, time=time, values=other))
    return tmp_path


def compared(first: Path | str, second: Path | str, **options: Any) -> dict[str, dict[str, str]]:
    """Compare two files, save the results to `both`, and return the rows of the table by quantity."""
    out = compare(first, second, **options).save("both")
    with (out / "compare.csv").open(encoding="utf-8") as file:
        return {row["quantity"]: row for row in csv.DictReader(file)}


def test_two_motions_with_other_names_signs_rates_and_clocks_are_compared(folder):
    found = compared("ours.mot", "theirs.mot")
    assert set(found) == {"right_knee_flexion", "right_hip_flexion"}
    assert float(found["right_knee_flexion"]["rms"]) < 0.01
    hip_row = found["right_hip_flexion"]
    assert float(hip_row["bias"]) == pytest.approx(-4, abs=0.01)
    assert float(hip_row["limit_low"]) == pytest.approx(-4, abs=0.02)
    assert float(hip_row["shift_s"]) == pytest.approx(SHIFT, abs=1e-4)
    assert float(hip_row["correlation"]) == pytest.approx(1, abs=1e-3)
    assert sorted(path.name for path in (folder / "both").iterdir()) == ["compare.csv", "report.html", "run.json"]
    record = json.loads((folder / "both" / "run.json").read_text())
    assert record["command"] == "compare"
    assert set(record["inputs"]) == {"ours.mot", "theirs.mot"}


def test_the_report_is_one_page_with_curves_scatters_and_the_table(folder):
    compared("ours.mot", "theirs.mot")
    page = (folder / "both" / "report.html").read_text()
    assert "http" not in page.replace("http-equiv", "")
    for text in ("right knee flexion", '"scatter":true', "−4.00", "limits of agreement", "ours and theirs"):
        assert text in page


def test_points_in_two_laboratories_are_compared_in_one(folder):
    second_from_first = RigidTransform.from_vector(np.array([0.2, 0.1, -2.0]), np.array([1.0, -3.0, 0.2]))
    points = np.stack(
        [np.stack([TIME, 0.3 * np.sin(3 * TIME + k), 0.5 * k + 0.1 * np.cos(7 * TIME)], 1) for k in range(3)], 1
    )
    write_trc(folder / "a.trc", PointPaths(names=("LHip", "LKnee", "LAnkle"), time=TIME, rate=100, points=points))
    names = ("left_hip", "left_knee", "left_ankle")
    moved = second_from_first.apply(points)
    write_trc(folder / "b.trc", PointPaths(names=names, time=TIME + 0.1, rate=100, points=moved))
    found = compared("a.trc", "b.trc")
    assert float(found["left_knee distance"]["rms"]) < 0.01
    assert found["left_knee distance"]["limit_low"] == ""
    assert float(found["left_hip x"]["shift_s"]) == pytest.approx(0.1, abs=1e-5)


def test_bones_are_compared_by_origins_turns_and_joint_angles(folder, shared):
    truth = shared / "data" / "markers" / "sta" / "ottawa_walking.npz"
    with np.load(truth) as file:
        bones = {key: file[key] for key in file.files if key.endswith(("_rotation", "_origin"))}
        rate = file["rate"]
    write_arrays(folder / "bones.npz", {**bones, "rate": rate})
    found = compared(folder / "bones.npz", truth)
    assert {"knee_flexion", "thigh_origin distance", "shank rotation"} <= set(found)
    assert float(found["knee_rotation"]["rms"]) < 1e-4


def test_other_names_are_given_in_a_file(folder):
    write_table(
        folder / "odd.mot", TimeSeriesTable(name="c", columns=("Knie", "Huefte"), time=TIME,
        values=np.stack([-knee(TIME), hip(TIME)], 1)),
    )  # fmt: skip
    with pytest.raises(MareyError, match="--map"):
        compare("ours.mot", "odd.mot")
    (folder / "names.toml").write_text('[angles]\nright_knee_flexion = "-Knie"\n')
    found = compared("ours.mot", "odd.mot", names="names.toml")
    assert list(found) == ["right_knee_flexion"]
    assert float(found["right_knee_flexion"]["rms"]) < 1e-3


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("[angle]\na = 'b'\n", "unknown key 'angle'"),
        ("[angles]\nright_knee_flexion = 3\n", "not a name"),
        ("[angles]\nright_knee_flexion = 'nothing'\n", "names the angles nothing"),
        ("[angles\n", "is not TOML"),
    ],
)
def test_a_wrong_file_of_names_is_reported(folder, text, wrong):
    (folder / "names.toml").write_text(text)
    with pytest.raises(MareyError, match=re.escape(wrong)):
        compare("ours.mot", "theirs.mot", names="names.toml")


@pytest.mark.parametrize(
    ("first", "second", "options", "wrong"),
    [
        ("nothing.mot", "ours.mot", {}, "nothing.mot: does not exist"),
        ("ours.mot", ".", {}, "contains neither motion.npz nor bones.npz"),
        ("ours.mot", "theirs.mot", {"shift": 60.0}, "no time in common"),
        ("ours.mot", "notes.txt", {}, "is not a file of a motion"),
    ],
)
def test_wrong_input_is_an_error(folder, first, second, options, wrong):
    (folder / "notes.txt").write_text("x")
    with pytest.raises(MareyError, match=re.escape(wrong)):
        compare(first, second, **options)
