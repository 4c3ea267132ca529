"""The page of curves: one file, every number in it readable by the page's own script."""

import base64
import json
import re

import numpy as np

from marey.view.pages.curves import (
    CurvePlot,
    CurvesContent,
    NumberTable,
    PlotGroup,
    ScatterPlot,
    Trace,
    curves_html,
)
from marey.view.pages.html import MOST_FRAMES


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
    assert not re.search(r'(src|href)="(?!#)', page)
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
