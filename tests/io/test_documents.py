"""Text, JSON, TOML and XML within limits."""

import json

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io import documents
from marey.io.documents import (
    finite,
    finite_number,
    numbers,
    read_json,
    read_json_table,
    read_rows,
    read_tables,
    read_text,
    read_xml,
    whole_number,
)

REMEDY = "Write it again."


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (read_json, "[" * 100_000), (read_json, "9" * 5000), (read_json, "{"), (read_json, ""),
        (read_tables, "a = " + "[" * 100_000), (read_tables, "a = " + "9" * 5000), (read_tables, "a ="),
        (read_xml, "<a>" * 10), (read_xml, '<?xml version="1.0" encoding="nonsense"?><a/>'),
        (read_xml, '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>'), (read_json_table, "[1]"),
    ],
)  # fmt: skip
def test_what_is_no_document_is_reported_in_one_line(tmp_path, read, text):
    path = tmp_path / "file"
    path.write_text(text)
    with pytest.raises(FileProblem, match=r"file: (is not|defines entities)") as caught:
        read(path, REMEDY)
    assert "\n" not in str(caught.value)


def test_a_missing_file_text_in_another_encoding_and_a_large_file_are_named(tmp_path, monkeypatch):
    with pytest.raises(FileProblem, match="none: does not exist"):
        read_text(tmp_path / "none", REMEDY)
    with pytest.raises(FileProblem, match="cannot be read"):
        read_text(tmp_path, REMEDY)
    with pytest.raises(FileProblem, match="cannot be read"):
        read_text(tmp_path / "a\0b", REMEDY)
    path = tmp_path / "file"
    path.write_bytes(b"ab\xff")
    with pytest.raises(FileProblem, match=r"is not text in UTF-8 \(byte 2\)"):
        read_text(path, REMEDY)
    monkeypatch.setattr(documents, "LARGEST_DOCUMENT", 2)
    with pytest.raises(FileProblem, match="too large"):
        read_text(path, REMEDY)


def test_cells_that_are_longer_than_any_number_are_reported_in_one_line():
    assert read_rows("a.csv", ["1;2", "3"], REMEDY, delimiter=";") == [["1", "2"], ["3"]]
    with pytest.raises(FileProblem, match=r"a.csv: is not a table of text \(field larger than field limit"):
        read_rows("a.csv", ["x" * 200_000], REMEDY)


@pytest.mark.parametrize("lines", [['a,"b', "1,2"], ['a,"b', '1,"', "3,4"]])
def test_no_row_is_swallowed_by_a_quotation_mark(lines):
    assert read_rows("a.csv", ['"a",b', "1,2"], REMEDY) == [["a", "b"], ["1", "2"]]
    with pytest.raises(FileProblem, match=r"a.csv: (is not a table of text|has a quotation mark)"):
        read_rows("a.csv", lines, REMEDY)


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path):
    path = tmp_path / "file.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps({"a": 1}).encode())
    assert read_json_table(path, REMEDY) == {"a": 1}


def test_lists_become_arrays_of_the_required_shape():
    np.testing.assert_array_equal(numbers([[1, 2], [3, 4]], (-1, 2)), [[1, 2], [3, 4]])
    np.testing.assert_array_equal(numbers([1, 2], None), [1, 2])
    for value in ([[1, 2], [3]], "x", [10**400], None, [[1, 2]], {}):
        assert numbers(value, (2,)) is None
    assert finite([1.0, float("nan")], (2,)) is None


def test_single_numbers_are_finite_and_no_texts():
    assert (finite_number(3), finite_number(-1.5)) == (3.0, -1.5)
    assert [finite_number(value) for value in (True, "3", None, float("inf"), 10**400, [3])] == [None] * 6
    assert (whole_number(3.0, least=0, greatest=5), whole_number("4", least=0, greatest=5)) == (3, 4)
    for value in (True, 3.5, 6, -1, None, "x", 10**400, float("nan"), float("inf"), "9" * 5000):
        assert whole_number(value, least=0, greatest=5) is None
