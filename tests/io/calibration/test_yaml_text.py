"""The YAML of OpenCV and of metadata, read without code."""

import cv2
import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.calibration.yaml_text import read_yaml

REMEDY = "It should be YAML."


def read(tmp_path, text: str):
    (tmp_path / "a.yml").write_bytes(text.encode())
    return read_yaml(tmp_path / "a.yml", REMEDY)


def test_tables_lists_and_texts_are_read(tmp_path):
    text = """%YAML:1.0
---
# a comment
names:
  - "01"
  - left
flow: [ 1, 2.5,
   3. ]
board:
  width_n: 5   # inner corners
  placement: backWall
  inner:
    deep: 'yes: it is'
empty:
last: !!opencv-matrix
   rows: 1
   data: [ .5 ]
"""
    assert read(tmp_path, text) == {
        "names": ["01", "left"],
        "flow": ["1", "2.5", "3."],
        "board": {"width_n": "5", "placement": "backWall", "inner": {"deep": "yes: it is"}},
        "empty": "",
        "last": {"rows": "1", "data": [".5"]},
    }


def test_lines_may_end_as_on_windows(tmp_path):
    assert read(tmp_path, "%YAML:1.0\r\n---\r\na: 1\r\nb:\r\n  - 2\r\n") == {"a": "1", "b": ["2"]}


def test_what_opencv_writes_is_read(tmp_path, rng):
    matrix = rng.normal(size=(7, 9))
    storage = cv2.FileStorage(str(tmp_path / "a.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("A", matrix)
    storage.write("number", 3)
    storage.release()
    content = read_yaml(tmp_path / "a.yml", REMEDY)
    table = content["A"]
    assert isinstance(table, dict)
    assert np.array_equal(np.array(table["data"], float).reshape(7, 9), matrix)
    assert content["number"] == "3"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- a\n- b\n", "is not a table"),
        ("a: 1\nb\n", "line 2 is not a key with a value"),
        ("a: 1\na: 2\n", "line 2 repeats the key 'a'"),
        ("a: 1\n   b: 2\n", "line 2 has another indentation"),
        ("a: [ 1, 2\n", "begins a list that is not closed"),
        ("a: [[1], [2]]\n", "nested or not closed"),
        ("a: &x 1\n", "unsupported form"),
        ("a: *x\n", "unsupported form"),
        ("a: |\n  text\n", "unsupported form"),
        ("a:\n\tb: 1\n", "is indented by a tab"),
        ("a: !!python/object/apply:os.system [ls]\nb\n", "line 2 is not a key"),
        ("a: \xff", ""),
    ],
)
def test_a_wrong_line_is_named(tmp_path, text, message):
    if not message:
        (tmp_path / "a.yml").write_bytes(b"a: \xff")
        with pytest.raises(FileProblem, match="is not text in UTF-8"):
            read_yaml(tmp_path / "a.yml", REMEDY)
        return
    with pytest.raises(FileProblem, match=message):
        read(tmp_path, text)


def test_deeply_nested_tables_are_refused(tmp_path):
    text = "".join(" " * depth + "a:\n" for depth in range(3000))
    with pytest.raises(FileProblem, match="nested in more than 20 levels"):
        read(tmp_path, text)
    with pytest.raises(FileProblem, match=r"cannot be read"):
        read(tmp_path, "a: " + "[" * 100000)
