"""Plots of one quantity: each subject's mean with its standard error, and the mean over the subjects, as SVG."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from markupsafe import Markup

from marey.io.study.tables import MeanRow, SubjectRow
from marey.view.pages.curves import COLOURS
from marey.wording import count_of

_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM, _ROW = 350, 112, 10, 6, 24, 34
"""Width of a plot, its margins, and the height of a row [px]. Chosen by eye."""
_TICKS = 5
"""Number of labelled places on the axis, about. Chosen by eye."""
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
    height = _TOP + len(rows) * _ROW + _BOTTOM
    parts = [*_axis(low, high, height)]
    for number, row in enumerate(rows):
        parts += _drawn(row, _TOP + (number + 0.5) * _ROW, low, high)
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


def _axis(low: float, high: float, height: int) -> list[str]:
    step = _step((high - low) / _TICKS)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    parts, bottom = [], height - _BOTTOM
    for k in range(math.ceil(low / step), math.floor(high / step) + 1):
        x = _place(k * step, low, high)
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{bottom}"/>')
        text = f"{k * step + 0.0:.{digits}f}".replace("-", "−")
        parts.append(f'<text class="tick" x="{x:.1f}" y="{bottom + 15}">{text}</text>')
    return parts


def _step(rough: float) -> float:
    """Return 1, 2 or 5 times a power of ten that is at least a number."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))


def _drawn(row: _Row, y: float, low: float, high: float) -> list[str]:
    label = row.label if len(row.label) <= _LONGEST_LABEL else f"{row.label[: _LONGEST_LABEL - 1]}…"
    parts = [f'<text class="name" x="{_LEFT - 8}" y="{y + 4:.1f}">{escape(label)}</text>']
    known = [each for each in row.subjects if math.isfinite(each.mean)]
    for k, each in enumerate(known):
        at = y - 12 + 15 * (k + 0.5) / len(known)
        name = f"{each.subject}: {each.mean:.4g} ({count_of(each.trials, 'trial')})"
        parts.append(f'<g stroke="{row.colour}" fill="{row.colour}" opacity="0.6">')
        ends = (each.mean - each.standard_error, each.mean + each.standard_error)
        parts.append(_line(*ends, at, (low, high), 1))
        x = _place(each.mean, low, high)
        parts.append(f'<circle cx="{x:.1f}" cy="{at:.1f}" r="2.6"><title>{escape(name)}</title></circle></g>')
    at, x = y + 9, _place(row.mean.mean, low, high)
    interval = _line(row.mean.low95, row.mean.high95, at, (low, high), 3)
    parts.append(f'<g stroke="{row.colour}" fill="{row.colour}">{interval}')
    mean = f"mean of {count_of(row.mean.subjects, 'subject')}"
    shape = f"M{x - 5:.1f} {at:.1f}L{x:.1f} {at - 5:.1f}L{x + 5:.1f} {at:.1f}L{x:.1f} {at + 5:.1f}Z"
    parts.append(f'<path d="{shape}"><title>{mean}</title></path></g>')
    return parts


def _line(start: float, end: float, y: float, span: tuple[float, float], width: int) -> str:
    """Return the line of an interval, cut at the ends of the axis; nothing if the interval is unknown."""
    if not (math.isfinite(start) and math.isfinite(end)):
        return ""
    first, last = (_place(min(max(number, span[0]), span[1]), *span) for number in (start, end))
    return f'<line x1="{first:.1f}" x2="{last:.1f}" y1="{y:.1f}" y2="{y:.1f}" stroke-width="{width}"/>'


def _place(value: float, low: float, high: float) -> float:
    return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (value - low) / (high - low)
