"""The headline figures of docs/accuracy.md are cells of records."""

from pathlib import Path

import pytest
from bench.declaration import Bench, find_benches
from bench.headline import BEGIN, END, HEADLINES, Headline, cells, with_headlines
from bench.recording import Column, Table, read_record, record_path
from tests.bench.test_recording import made_record

COLUMNS = (Column("joints", "mm", 1), Column("IoU", "", 3))
TABLE = Table(
    "All cameras", ("take", "body"), COLUMNS, [(("walk", "a"), (6.64, 0.972)), (("reach", "a"), (8.96, None))]
)


def headline(**changes: object) -> Headline:
    given = {
        "quantity": "Joints",
        "record": "capture/takes",
        "table": "All",
        "column": "joints",
        "rows": [["walk"], ["reach"]],
    }
    return Headline(**given | changes)


def test_cells_are_listed_with_their_unit():
    assert cells(headline(), made_record(TABLE)) == "6.6, 9.0 mm"


@pytest.mark.parametrize("changes", [{"table": "Other"}, {"column": "other"}])
def test_what_a_record_lacks_is_not_measured(changes: dict):
    assert cells(headline(**changes), made_record(TABLE)) == "not measured"


def test_a_missing_row_is_a_dash():
    assert cells(headline(rows=[["jacks"]]), made_record(TABLE)) == "- mm"


def test_only_the_table_between_the_lines_is_replaced(tmp_path: Path):
    record = made_record(TABLE, source="taken over")
    records = {record_path("capture/takes", [], tmp_path): record}
    benches = {"capture/takes": Bench(measures="Joints.", sources=("src",), minutes=1, name="capture/takes")}
    text = with_headlines(f"Before.\n{BEGIN}\nold table\n{END}\nAfter.\n", records, benches, tmp_path)
    assert text.startswith(f"Before.\n{BEGIN}\n| quantity")
    assert text.endswith(f"{END}\nAfter.\n")
    assert "old table" not in text
    assert "| - mm | [takes](accuracy/capture.md), **not re-measured** |" in text
    assert "| not measured | [arm](accuracy/surface.md) |" in text


def test_a_page_without_the_lines_is_an_error(tmp_path: Path):
    with pytest.raises(ValueError, match="lacks the lines"):
        with_headlines("Text.", {}, {}, tmp_path)


@pytest.mark.slow
def test_headlines_name_benchmarks():
    assert {each.record.partition(".")[0] for each in HEADLINES} <= set(find_benches())


@pytest.mark.parametrize("each", HEADLINES, ids=lambda each: each.quantity)
def test_each_headline_is_found_in_its_record(each: Headline):
    text = cells(each, read_record(record_path(each.record, [])))
    assert text != "not measured"
    assert "-" not in text.split(" ")[: len(each.rows)]
    assert "-," not in text
