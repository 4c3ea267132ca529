"""The page of curves: one file, every number in it readable by the page's own script."""

import base64
import json
import re
from dataclasses import replace

import numpy as np

from marey.view.pages.curves import (
    CurvePlot,
    CurvesContent,
    NumberTable,
    PlotGroup,
    PlotMark,
    ScatterPlot,
    Trace,
    curves_html,
)
from marey.view.pages.html import MOST_FRAMES, PageHead


def content(frames=50, **changes):
    time = np.arange(frames) / 100
    wave = np.sin(time)
    plots = [
        CurvePlot(title="knee flexion", curves=[Trace(label="a", values=wave, sd=0 * wave + 0.1, colour="#2f5d8a")]),
        CurvePlot(
            title="over the cycle", axis=np.linspace(0, 100, 101),
            curves=[Trace(label="a", values=np.zeros(101), colour="#2f5d8a")],
        ),
        ScatterPlot(title="knee flexion", x=wave, y=wave, bias=0.1, low=np.nan, high=np.nan, unit="°"),
    ]  # fmt: skip
    given = {"tables": [NumberTable(title="Numbers", head=("a", "b"), rows=[["<x>", "1"]])], "notes": ["a <b> note"]}
    groups = [PlotGroup(title="Angles", plots=plots, keys=[("a", "#2f5d8a")])]
    return CurvesContent(kind="Test", title="t & t", time=time, groups=groups, **(given | changes))


def data(page: str) -> dict:
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)[1])


def floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4")


def test_the_page_loads_nothing_and_escapes_what_users_wrote():
    page = curves_html(content())
    # Links lead to places on the page and to the files beside it; nothing is loaded.
    assert not re.search(r'src="|href="(?!#|[\w.]+")', page)
    for text in ("t &amp; t", "a &lt;b&gt; note", "&lt;x&gt;"):
        assert text in page


def test_the_page_contains_the_curves_as_given():
    plots = data(curves_html(content()))["groups"][0]["plots"]
    np.testing.assert_allclose(floats(plots[0]["curves"][0]["values"]), np.sin(np.arange(50) / 100), atol=1e-6)
    assert len(floats(plots[1]["axis"])) == 101
    assert plots[0]["axis"] is None
    # JSON knows no NaN.
    assert plots[2]["low"] is None
    assert plots[2]["bias"] == 0.1


def test_long_trials_are_shown_by_every_so_many_frames_but_cycles_whole():
    shown = data(curves_html(content(frames=2 * MOST_FRAMES + 1)))
    frames = len(floats(shown["time"]))
    assert frames <= MOST_FRAMES
    assert len(floats(shown["groups"][0]["plots"][0]["curves"][0]["values"])) == frames
    assert len(floats(shown["groups"][0]["plots"][1]["curves"][0]["values"])) == 101


def test_vertical_lines_of_a_plot_are_in_the_page():
    marked = CurvePlot(
        title="cycle", axis=np.linspace(0, 100, 3), marks=[PlotMark(at=62.0, colour="#2f6db5", dotted=True)],
        curves=[Trace(label="a", values=np.zeros(3), colour="#2f5d8a")],
    )  # fmt: skip
    groups = data(curves_html(replace(content(), groups=[PlotGroup(title="Cycle", plots=[marked])])))["groups"]
    assert groups[0]["plots"][0]["marks"] == [{"at": 62.0, "colour": "#2f6db5", "dotted": True}]


def test_the_plots_show_the_chosen_frames_and_nothing_that_is_empty():
    given = content()
    empty = CurvePlot(title="nothing", curves=[Trace(label="a", values=np.full(50, np.nan), colour="#2f5d8a")])
    groups = [PlotGroup(title="Empty", plots=[empty]), PlotGroup(title="Angles", plots=[*given.groups[0].plots, empty])]
    page = curves_html(replace(given, groups=groups, shown=slice(10, 30)))
    assert "Empty" not in page
    shown = data(page)
    np.testing.assert_allclose(floats(shown["time"]), np.arange(10, 30) / 100, rtol=1e-6)
    assert shown["groups"][0]["plots"] == []
    assert [plot["title"] for plot in shown["groups"][1]["plots"]] == ["knee flexion", "over the cycle", "knee flexion"]
    assert len(floats(shown["groups"][1]["plots"][0]["curves"][0]["values"])) == 20


def test_notes_that_the_verdict_contains_are_not_repeated_and_the_rest_is_folded():
    notes = ["The camera cam02 was moved.", *(f"Note {k}." for k in range(8))]
    head = PageHead(verdict=("usable with limits", ["The camera cam02 was moved. Calibrate it."]), grades=["caution"])
    page = curves_html(content(notes=notes, head=head))
    assert page.count("The camera cam02 was moved.") == 1
    # With the reason of the verdict, six notes are seven entries.
    assert "<summary>2 more notes</summary>" in page
    assert page.index("Note 5.") < page.index("<details>") < page.index("Note 6.")


def test_the_gravest_reasons_come_first_and_seven_entries_are_not_folded():
    reasons = [*(f"Failure {k}." for k in range(2)), *(f"Limit {k}." for k in range(5)), "Known."]
    head = PageHead(verdict=("not usable", reasons), grades=[*["problem"] * 2, *["caution"] * 5, "note"])
    page = curves_html(content(notes=["A note."], head=head))
    order = ["Verdict: not usable", "Failure 1.", "Further limits:", "Limit 4.", "<summary>1 more</summary>",
             "Further notes:", "Known.", "<summary>1 note</summary>", "A note."]  # fmt: skip
    places = [page.index(text) for text in order]
    assert places == sorted(places)
    assert page.count("<li>") == len(reasons)


def test_reasons_of_one_kind_have_no_headings_between_them():
    for grade, level in (("caution", "usable with limits"), ("problem", "not usable")):
        page = curves_html(content(head=PageHead(verdict=(level, ["One.", "Two.", "Three."]), grades=[grade] * 3)))
        assert "Further" not in page
        assert "<details>" not in page
        assert page.count("<li>") == 3


def test_notes_on_one_subject_are_one_row():
    notes = ["Method skin: thigh: 5 mm.", "A gap was filled.", "Method skin: shank: 2 mm.", "A gap was filled."]
    page = curves_html(content(notes=notes))
    assert "Method skin: thigh: 5 mm. shank: 2 mm.<" in page
    assert page.count("A gap was filled.") == 1


def test_the_head_states_command_date_and_person():
    head = PageHead(command="marey markers", finished="2026-01-02 03:04 UTC", person="2")
    page = curves_html(content(head=head))
    assert "Person 2 · <code>marey markers</code> · 2026-01-02 03:04 UTC · marey " in page
