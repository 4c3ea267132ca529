"""Plots of one quantity: each subject's mean with its standard error, and the mean over the subjects, as SVG."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from markupsafe import Markup

from marey.io.study.tables import MeanRow, SubjectRow
from marey.view.pages.curves import COLOURS
from marey.view.svg.axis import SvgAxis
from marey.wording import count_of

_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM, _ROW = 350, 112, 10, 6, 24, 34
"""Width of a plot, its margins, and the height of a row [px]. Chosen by eye."""
_LONGEST_LABEL = 16
"""Largest length of the label of a row [characters]. Chosen by eye."""


@dataclass(frozen=True, kw_only=True)
class DotPlot:
    """The plot of one quantity."""

    title: str
    svg: Markup
    """The drawing, safe to be part of a page."""


@dataclass(frozen=True, kw_only=True)
class _Row:
    """One row of a plot: a condition and a side."""

    label: str
    colour: str
    mean: MeanRow
    subjects: Sequence[SubjectRow]


def dot_plot(title: str, means: Sequence[MeanRow], subjects: Sequence[SubjectRow]) -> DotPlot | None:
    """Draw one quantity: a row per condition and side.

    Args:
        title: The quantity with its unit.
        means: The means over subjects, one per condition and side.
        subjects: The means of the subjects.

    Returns:
        The plot; None without a finite number.
    """
    conditions = sorted({mean.condition for mean in means})
    rows = [
        _Row(
            label=" ".join(part for part in (mean.condition, mean.side) if part) or "all", mean=mean,
            colour=COLOURS[conditions.index(mean.condition) % len(COLOURS)],
            subjects=[each for each in subjects if (each.condition, each.side) == (mean.condition, mean.side)],
        )
        for mean in means if math.isfinite(mean.mean)
    ]  # fmt: skip
    if not rows:
        return None
    low, high = _span(rows)
    axis = SvgAxis(low=low, high=high, left=_LEFT, right=_WIDTH - _RIGHT)
    bottom = _TOP + len(rows) * _ROW
    height = bottom + _BOTTOM
    parts = [*axis.grid(_TOP, bottom)]
    for number, row in enumerate(rows):
        parts += _drawn(row, _TOP + (number + 0.5) * _ROW, axis)
    head = f'<svg class="dots" viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{escape(title)}">'
    return DotPlot(title=title, svg=Markup(f"{head}{''.join(parts)}</svg>"))


def _span(rows: Sequence[_Row]) -> tuple[float, float]:
    """Return the ends of the axis: all means, and the intervals of the group means."""
    numbers = [each.mean for row in rows for each in row.subjects]
    numbers += [number for row in rows for number in (row.mean.mean, row.mean.low95, row.mean.high95)]
    finite = [number for number in numbers if math.isfinite(number)]
    low, high = min(finite), max(finite)
    margin = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _drawn(row: _Row, y: float, axis: SvgAxis) -> list[str]:
    label = row.label if len(row.label) <= _LONGEST_LABEL else f"{row.label[: _LONGEST_LABEL - 1]}…"
    parts = [f'<text class="name" x="{_LEFT - 8}" y="{y + 4:.1f}">{escape(label)}</text>']
    known = [each for each in row.subjects if math.isfinite(each.mean)]
    for k, each in enumerate(known):
        at = y - 12 + 15 * (k + 0.5) / len(known)
        name = f"{each.subject}: {each.mean:.4g} ({count_of(each.trials, 'trial')})"
        parts.append(f'<g stroke="{row.colour}" fill="{row.colour}" opacity="0.6">')
        ends = (each.mean - each.standard_error, each.mean + each.standard_error)
        parts.append(_line(*ends, at, axis, 1))
        x = axis.place(each.mean)
        parts.append(f'<circle cx="{x:.1f}" cy="{at:.1f}" r="2.6"><title>{escape(name)}</title></circle></g>')
    at, x = y + 9, axis.place(row.mean.mean)
    interval = _line(row.mean.low95, row.mean.high95, at, axis, 3)
    parts.append(f'<g stroke="{row.colour}" fill="{row.colour}">{interval}')
    mean = f"mean of {count_of(row.mean.subjects, 'subject')}"
    shape = f"M{x - 5:.1f} {at:.1f}L{x:.1f} {at - 5:.1f}L{x + 5:.1f} {at:.1f}L{x:.1f} {at + 5:.1f}Z"
    parts.append(f'<path d="{shape}"><title>{mean}</title></path></g>')
    return parts


def _line(start: float, end: float, y: float, axis: SvgAxis, width: int) -> str:
    """Return the line of an interval, cut at the ends of the axis; nothing if the interval is unknown."""
    if not (math.isfinite(start) and math.isfinite(end)):
        return ""
    first, last = axis.place(start), axis.place(end)
    return f'<line x1="{first:.1f}" x2="{last:.1f}" y1="{y:.1f}" y2="{y:.1f}" stroke-width="{width}"/>'
