"""Tables and their records."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from bench.recording import Column, Record, Run, Table, read_record, read_records, record_path, write_record

JOINTS = Column("joints", "mm", 1)
KIND = Column("kind")


def made_run() -> Run:
    return Run(argparse.Namespace(), Path("shared"), Path("out"))


def made_record(*tables: Table, **changes: object) -> Record:
    return Record(
        **{
            "bench": "capture/takes", "command": "python -m bench run capture/takes", "commit": "0" * 40,
            "dirty": False, "date": "2026-01-31", "machine": {"processor": "made", "cores": "2"}, "seconds": 3.5,
            "tables": tables,
        } | changes
    )  # fmt: skip


def test_a_table_prints_its_rows_with_their_digits_as_they_come(capsys: pytest.CaptureFixture[str]):
    table = made_run().table("Takes", "take", JOINTS, KIND)
    table.row("walk", np.float64(6.6449), "rendered")
    assert "take | joints [mm] | kind\nwalk | 6.6 | rendered\n" in capsys.readouterr().out


@pytest.mark.parametrize("missing", [None, float("nan")])
def test_a_missing_value_prints_as_a_dash(missing: float | None):
    assert JOINTS.text(missing) == "-"


def test_a_whole_number_prints_without_a_decimal_point():
    assert KIND.text(3683291.0) == "3683291"
    assert KIND.text(0.5) == "0.5"


def test_a_row_of_another_length_is_rejected():
    table = made_run().table("Takes", "take", JOINTS)
    with pytest.raises(ValueError, match="1 labels and 1 values"):
        table.row("walk", 1.0, 2.0)


def test_a_value_that_is_no_figure_is_rejected():
    table = made_run().table("Takes", "take", JOINTS)
    with pytest.raises(ValueError, match="not list"):
        table.row("walk", [1.0])


def test_a_record_is_read_as_it_was_written(tmp_path: Path):
    table = made_run().table("Takes", ("take", "camera"), JOINTS, KIND, note="One row per take.")
    table.row(("walk", "cam01"), 6.64, "rendered")
    table.row(("reach", "cam01"), None, "rendered")
    write_record(made_record(table, note="shared machine"), tmp_path / "capture" / "takes.json")
    read = read_record(tmp_path / "capture" / "takes.json")
    assert read.tables[0].rows == table.rows
    assert (read.tables[0].columns, read.tables[0].note) == (table.columns, table.note)
    assert (read.commit, read.note, read.seconds) == ("0" * 40, "shared machine", 3.5)


def test_what_is_not_finite_is_written_as_missing(tmp_path: Path):
    table = made_run().table("Takes", "take", JOINTS)
    table.row("walk", float("inf"))
    write_record(made_record(table), tmp_path / "takes.json")
    assert json.loads((tmp_path / "takes.json").read_text())["tables"][0]["rows"][0]["values"] == [None]


def test_arguments_name_the_record(tmp_path: Path):
    assert record_path("knee/bones", [], tmp_path) == tmp_path / "knee" / "bones.json"
    with_arguments = record_path("knee/bones", ["phantom_a", "--seeds", "2"], tmp_path)
    assert with_arguments == tmp_path / "knee" / "bones.phantom-a.seeds.2.json"


def test_records_are_found_by_benchmark(tmp_path: Path):
    write_record(made_record(), record_path("capture/takes", [], tmp_path))
    write_record(made_record(), record_path("capture/takes", ["walk"], tmp_path))
    assert [path.name for path, _ in read_records(tmp_path)["capture/takes"]] == ["takes.json", "takes.walk.json"]
