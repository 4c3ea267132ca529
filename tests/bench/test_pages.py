"""Pages are written from records, and mark what is old."""

from pathlib import Path

import pytest
from bench.pages import mark, provenance, table_text, write_pages
from bench.provenance import Age
from bench.recording import Column, Table, record_path, write_record
from tests.bench.test_provenance import commit, project  # noqa: F401  (a fixture)
from tests.bench.test_recording import made_record

TABLE = Table(
    "Takes", ("take",), (Column("joints", "mm", 1), Column("IoU", "", 3)), [(("walk",), (6.64, None))], "A note."
)
BENCH = 'BENCH = Bench(measures="Joints of takes.", sources=("src",), minutes=2)\n'


def test_a_table_keeps_units_digits_and_note():
    text = table_text(TABLE)
    assert "| take | joints [mm] | IoU |\n| --- | --- | --- |\n| walk | 6.6 | - |\n" in text
    assert text.startswith("**Takes**")
    assert text.endswith("A note.\n")


def test_what_was_typed_is_no_markup_in_a_cell():
    table = Table("Typed", ("typed",), (Column("line"),))
    table.row("a\nb\0", "<script>")
    assert "| a b\\x00 | &lt;script> |" in table_text(table)


def test_a_bar_in_a_cell_does_not_end_the_cell():
    assert "a\\|b" in table_text(Table("Takes", ("take",), (), [(("a|b",), ())]))


@pytest.mark.parametrize(
    ("how", "text"),
    [
        (Age(known=False), "not part of this history"),
        (Age(known=True, commits=("abc1234",), files=("src/fit.py",)), "last in commit abc1234 (`src/fit.py`)"),
        (Age(known=True, commits=("abc",), files=tuple("abcde")), "and 2 more files"),
    ],
)
def test_an_old_record_is_marked(how: Age, text: str):
    assert "**OLD**" in mark(how)
    assert text in mark(how)


def test_a_current_record_is_not_marked():
    assert mark(Age(known=True)) == ""
    assert mark(Age(known=True, commits=("abc1234",))) == ""


def test_carried_figures_are_marked_and_name_no_commit():
    text = provenance(None, made_record(TABLE, source="taken over from a page"))
    assert text == "**NOT RE-MEASURED**: taken over from a page.\n"


def test_pages_follow_the_history(project: Path):  # noqa: F811
    commit(project, "bench/capture/takes.py", BENCH)
    measured = commit(project, "bench/capture/other.py", BENCH)
    records = project / "bench" / "records"
    record = made_record(TABLE, commit=measured, dirty=True, note="Shared machine.")
    write_record(record, record_path("capture/takes", [], records))

    def page() -> str:
        folders = project / "docs" / "accuracy", project / "bench", records, project
        return next(path for path in write_pages(*folders) if path.stem == "capture").read_text()

    text = page()
    assert "    python -m bench run capture/takes\n" in text
    assert f"Commit {measured[:7]}, 2026-01-31" in text
    assert "Shared machine." in text
    assert "**UNCOMMITTED CHANGES**" in text
    assert "- `capture/other` (about 2 min): Joints of takes." in text
    assert "**OLD**:" not in text
    commit(project, "src/fit.py", "WEIGHT = 2\n")
    assert "**OLD**: the measured code has changed since" in page()
