"""Names from files are text in every page, and never markup."""

import re
from importlib.resources import files

import numpy as np
import pytest

from marey.cli.main import run
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.view.pages.html import files_beside, gravest, span_of

PAGES = sorted(path.name for path in files("marey.view").joinpath("page").iterdir())
TIME = np.arange(0, 4, 0.01)


@pytest.mark.parametrize("name", PAGES)
def test_templates_and_scripts_insert_nothing_as_markup(name):
    text = files("marey.view").joinpath("page", name).read_text(encoding="utf-8")
    # All are JSON, in which the sign "<" is written as an escape.
    assert set(re.findall(r"\{\{\s*([^}]*?)\|\s*safe\s*\}\}", text)) <= {"data", "embedded", "about "}
    assert "autoescape" not in text
    for inserted in re.findall(r"innerHTML\s*=\s*(.*)", text):
        assert re.fullmatch(r'"[^"]*";', inserted), inserted
    assert not re.search(r"outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function", text)


def test_a_name_with_markup_is_text_in_a_report(tmp_path):
    name = "<script>alert(1)</script>"
    values = 30 * np.sin(5 * TIME) + 5 * np.sin(11 * TIME) + 3 * TIME
    for file in ("<img src=x>.mot", "b.mot"):
        write_table(tmp_path / file, TimeSeriesTable(name="a", columns=(name,), time=TIME, values=values[:, None]))
    out = tmp_path / "out"
    assert run(["compare", str(tmp_path / "<img src=x>.mot"), str(tmp_path / "b.mot"), "--out", str(out), "-q"]) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "alert(1)" in page
    assert "<script>alert" not in page
    assert "<img src=x>" not in page
    assert "&lt;img src=x&gt;" in page


def test_files_beside_a_page_are_those_that_exist():
    files = {"a.csv, b.csv": "tables", "overlay_<camera>.mp4": "videos", "masks/": "silhouettes", "run.json": "the run"}
    names = ["b.csv", "overlay_cam02.mp4", "overlay_cam01.mp4", "masks", "other.txt"]
    assert files_beside(files, names) == {
        "b.csv": "tables", "overlay_cam01.mp4, overlay_cam02.mp4": "videos", "masks/": "silhouettes",
        "run.json": "the run",
    }  # fmt: skip
    assert files_beside(files, []) == {"run.json": "the run"}


def test_the_requested_frames_span_from_the_first_to_the_last():
    assert span_of(np.array([False, True, False, True, False])) == slice(1, 4)
    assert span_of(np.zeros(5, bool)) == slice(None)


def test_the_gravest_entries_of_all_lists_are_shown_and_those_of_earlier_lists_before_equal_ones():
    assert gravest(["problem"], ["problem", "caution"], ["note"]) == [1, 2, 1]
    assert gravest(["caution"] * 6, ["problem", "caution", "caution"], ["note"]) == [6, 1, 0]
    assert gravest(["problem"] * 9, ["problem"]) == [7, 0]
    assert gravest([], [], []) == [0, 0, 0]
