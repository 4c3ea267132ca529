"""A page of curves and tables in one HTML file, used by the reports of markers, shapes and comparisons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Mask
from marey.io.atomic import replacing
from marey.view.pages.html import MOST_FRAMES, PageHead, Still, packed, rendered

COLOURS = (
    "#2f5d8a", "#c0453f", "#3b7d4f", "#b5651d", "#7a4fb0", "#2f8a86", "#8a3b6b", "#6b6b1f", "#4c4f57", "#d39a2f",
)  # fmt: skip
"""Colours of curves in one plot, chosen by eye to be distinguishable."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trace:
    """One curve with optional standard deviations."""

    label: str
    values: Floats
    """(N,)."""
    colour: str
    sd: Floats | None = None
    """(N,)."""
    determined: Mask | None = None
    """(N,) where the images determine the value, for the page of `marey view`; None where that is not known."""


@dataclass(frozen=True, kw_only=True)
class PlotMark:
    """A vertical line in a plot."""

    at: float
    """Place on the horizontal axis."""
    colour: str
    dotted: bool = False
    """Whether the line is dotted; otherwise it is dashed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CurvePlot:
    """A plot of curves over the time of the page or over its own axis."""

    title: str
    curves: Sequence[Trace]
    unit: str = "°"
    least: float = 5.0
    """Smallest range of the vertical axis, in `unit`, so that noise is not magnified."""
    digits: int = 1
    axis: Floats | None = None
    """(N,) horizontal axis, for example 0 to 100 % of a cycle; None for the time of the page."""
    marks: Sequence[PlotMark] = ()
    """Vertical lines."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScatterPlot:
    """Differences over means with bias and limits of agreement."""

    title: str
    x: Floats
    y: Floats
    bias: float
    low: float
    high: float
    unit: str
    colour: str = COLOURS[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class PlotGroup:
    """A section of plots."""

    title: str
    plots: Sequence[CurvePlot | ScatterPlot]
    legend: str = ""
    keys: Sequence[tuple[str, str]] = ()
    """Labels and colours of the legend."""
    wide: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "plots", tuple(plot for plot in self.plots if _has_values(plot)))


def _has_values(plot: CurvePlot | ScatterPlot) -> bool:
    """Return whether a plot shows anything."""
    values = [plot.y] if isinstance(plot, ScatterPlot) else [trace.values for trace in plot.curves]
    return any(np.isfinite(each).any() for each in values)


@dataclass(frozen=True, eq=False, kw_only=True)
class NumberTable:
    """A section with a table."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    legend: str = ""
    marked: int = -1
    """Index of the highlighted row; -1 for none."""
    text_columns: Sequence[int] = (0,)
    """Indices of the columns that contain text."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CurvesContent:
    """Content of the page."""

    kind: str
    title: str
    time: Floats
    """(F,) [s]."""
    shown: slice | None = None
    """The frames that the plots over time show; all if None."""
    head: PageHead = field(default_factory=PageHead)
    tiles: Sequence[tuple[str, str, str]] = ()
    """Key figures: label, value, and the line below."""
    notes: Sequence[str] = ()
    tables: Sequence[NumberTable] = ()
    groups: Sequence[PlotGroup] = ()
    stills: Sequence[Still] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    meaning: Mapping[str, str] = field(default_factory=dict)


def write_curves_page(path: Path, content: CurvesContent) -> None:
    """Write the page.

    Args:
        path: The HTML file.
        content: The content of the page.
    """
    with replacing(path) as beside:
        beside.write_text(curves_html(content), encoding="utf-8")


def curves_html(content: CurvesContent) -> str:
    """Return the page as one HTML document that loads nothing from elsewhere."""
    frames = len(content.time[content.shown or slice(None)])
    return rendered("curves.html", content, data=curves_data(content, stride_of(frames)))


def stride_of(frames: int) -> int:
    """Return the step between the frames that a page contains."""
    return max(1, -(-frames // MOST_FRAMES))


def curves_data(content: CurvesContent, stride: int) -> dict[str, object]:
    """Return the data for the scripts of the page, with every `stride`-th frame of those that it shows."""
    shown = content.shown or slice(None)
    time = content.time[shown][::stride]
    return {
        "time": packed(time, "f4"),
        "state": packed(np.ones(len(time)), "u1"),
        "groups": [group_data(group, shown, stride) for group in content.groups],
    }


def group_data(group: PlotGroup, shown: slice = slice(None), stride: int = 1) -> dict[str, object]:
    """Return the data of a section for the scripts of the page."""
    return {"plots": [_plot(plot, shown, stride) for plot in group.plots]}


def _plot(plot: CurvePlot | ScatterPlot, shown: slice, stride: int) -> dict[str, object]:
    if isinstance(plot, ScatterPlot):
        return _scatter(plot, stride)
    shown, step = (slice(None), 1) if plot.axis is not None else (shown, stride)
    return {
        "title": plot.title, "unit": plot.unit, "least": plot.least, "digits": plot.digits,
        "axis": None if plot.axis is None else packed(plot.axis, "f4"), "marks": [vars(mark) for mark in plot.marks],
        "curves": [
            {
                "label": c.label, "colour": c.colour, "values": packed(c.values[shown][::step], "f4"),
                "sd": packed(c.sd[shown][::step], "f4") if c.sd is not None and np.isfinite(c.sd).any() else None,
            }
            for c in plot.curves
        ],
    }  # fmt: skip


def _scatter(plot: ScatterPlot, stride: int) -> dict[str, object]:
    ends = {name: value if np.isfinite(value) else None for name, value in vars(plot).items() if name in _ENDS}
    read = f"{plot.bias:+.2f} ({plot.low:+.2f} to {plot.high:+.2f}) {plot.unit}"
    return {
        "scatter": True, "title": plot.title, "x": packed(plot.x[::stride], "f4"), "y": packed(plot.y[::stride], "f4"),
        "colour": plot.colour, "read": read.replace("-", "−"), **ends,
    }  # fmt: skip


_ENDS = ("bias", "low", "high")
"""Values of a scatter plot that are drawn as horizontal lines."""
