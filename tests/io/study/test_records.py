"""Records of steps and tables of a study are read as they were written."""

import csv
from dataclasses import fields, replace

import numpy as np
import pytest

from marey.errors import NotWritten
from marey.io.study.inputs import recorded_inputs_are_unchanged, trial_fingerprint
from marey.io.study.records import StepRecord, StepValue, read_step_record, write_step_record
from marey.io.study.tables import StudyRow, write_parquet, write_table
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.run_record import write_record

VALUE = StepValue(quantity="speed", side="both", unit="m/s", value=1 / 3, low=0.1, high=float("nan"), count=4)
ROW = StudyRow(
    trial="S01/a", subject="S01", condition="", step="markers", quantity="speed", side="both", unit="m/s", value=1 / 3,
    low95=0.1, high95=float("nan"), cycles=4, flags="no interval",
)  # fmt: skip


def test_a_record_is_read_as_it_was_written(tmp_path):
    record = StepRecord(state="done", key="ab", verdict="good", reasons=("one", "two"), values=(VALUE,), seconds=2.5)
    write_step_record(tmp_path / "markers.json", record)
    found = read_step_record(tmp_path / "markers.json")
    assert found is not None
    assert np.isnan(found.values[0].high)
    assert replace(found, values=()) == replace(record, values=())
    assert replace(found.values[0], high=0.0) == replace(VALUE, high=0.0)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"state": "done"}', '{"values": [[1]], "reasons": []}'])
def test_a_damaged_record_counts_as_none(tmp_path, text):
    (tmp_path / "markers.json").write_text(text)
    assert read_step_record(tmp_path / "markers.json") is None


def test_a_record_on_a_full_disk_is_named(tmp_path, full_disk):
    with full_disk(10), pytest.raises(NotWritten, match=r"markers.json"):
        write_step_record(tmp_path / "markers.json", StepRecord(state="running", key="ab"))
    assert list(tmp_path.iterdir()) == []


def test_the_tables_keep_every_digit_and_unknown_numbers_are_empty(tmp_path):
    write_table(tmp_path / "study.csv", [ROW], StudyRow)
    with (tmp_path / "study.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert list(row) == [column.name for column in fields(StudyRow)]
    assert (float(row["value"]), row["high95"], row["cycles"]) == (1 / 3, "", "4")
    parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet needs the packages of the extra `study`")
    write_parquet(tmp_path / "study.parquet", [ROW])
    table = parquet.read_table(tmp_path / "study.parquet")
    assert table.column_names == list(row)
    assert table.to_pylist() == [{**vars(ROW), "high95": None}]
    write_parquet(tmp_path / "empty.parquet", [])
    assert parquet.read_table(tmp_path / "empty.parquet").schema == table.schema


def test_a_trial_changes_with_its_files_but_not_with_results_of_marey_in_it(tmp_path):
    (tmp_path / "cam01.mp4").write_text("film")
    before = trial_fingerprint(tmp_path)
    (tmp_path / "marey").mkdir()
    write_record(
        tmp_path / "marey", command="capture", settings={}, inputs=[tmp_path / "cam01.mp4"], root=tmp_path,
        progress=RecordingProgress(),
    )  # fmt: skip
    assert trial_fingerprint(tmp_path) == before
    assert recorded_inputs_are_unchanged(tmp_path / "marey", tmp_path)
    (tmp_path / "cam01.mp4").write_text("another film")
    assert trial_fingerprint(tmp_path) != before
    assert not recorded_inputs_are_unchanged(tmp_path / "marey", tmp_path)
    (tmp_path / "cam01.mp4").rename(tmp_path / "cam02.mp4")
    assert not recorded_inputs_are_unchanged(tmp_path / "marey", tmp_path)
