"""Bars of the distances between the angles of walks and those of reference walks, as SVG."""

from collections.abc import Sequence
from html import escape

from markupsafe import Markup

from marey.motion.events.profile import WHOLE_SCORE, ProfileScore
from marey.view.pages.problems import readable
from marey.view.pictures.palette import side_colour
from marey.view.svg.axis import SvgAxis

_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 720, 190, 46, 6, 24
"""Width of the drawing and its margins [px]. Chosen by eye."""
_BAR, _GAP = 12, 8
"""Height of a bar, and distance between rows [px]. Chosen by eye."""


def profile_bars(walks: Sequence[tuple[str, str | None, Sequence[ProfileScore]]]) -> Markup:
    """Draw the Movement Analysis Profile: for each angle and side one bar per walk, over what the references score.

    Args:
        walks: Name, colour and scores of each walk, at least one; a bar without a colour has that of its side.

    Returns:
        The drawing, safe to be part of a page: grey from zero to the median of the reference walks, with a line to the
        largest of them.
    """
    entries = [entry for _, _, scores in walks for entry in scores]
    rows = list(dict.fromkeys((entry.name, entry.side) for entry in entries))
    rows.sort(key=lambda row: row[0] == WHOLE_SCORE)
    height = len(walks) * _BAR + _GAP
    bottom = _TOP + len(rows) * height
    largest = max(max(entry.score_deg, entry.reference_worst_deg) for entry in entries)
    axis = SvgAxis(low=0.0, high=1.04 * largest or 1.0, left=_LEFT, right=_WIDTH - _RIGHT)
    parts = [*axis.grid(_TOP, bottom)]
    for number, row in enumerate(rows):
        bars = [
            (label, colour or side_colour(f"{row[1]}_"), entry)
            for label, colour, scores in walks for entry in scores if (entry.name, entry.side) == row
        ]  # fmt: skip
        parts += _row(bars, axis, _TOP + number * height + _GAP / 2)
    title = "Distances from the reference walks in degrees"
    head = f'<svg class="dots" viewBox="0 0 {_WIDTH} {bottom + _BOTTOM}" role="img" aria-label="{title}">'
    return Markup(f"{head}{''.join(parts)}</svg>")


def _row(bars: Sequence[tuple[str, str, ProfileScore]], axis: SvgAxis, top: float) -> list[str]:
    """Draw one angle of one side: the reference walks behind, and the bar of each walk."""
    usual, height = bars[0][2], len(bars) * _BAR
    label = readable(usual.name) if usual.side == "both" else f"{readable(usual.name)}, {usual.side}"
    start, median, worst = (axis.place(x) for x in (0.0, usual.reference_deg, usual.reference_worst_deg))
    middle = top + height / 2
    stated = f"reference walks: median {usual.reference_deg:.1f}°, largest {usual.reference_worst_deg:.1f}°"
    parts = [
        f'<text class="name" x="{_LEFT - 8}" y="{middle + 4:.1f}">{escape(label)}</text>',
        _bar("class", "usual", (start, median), top - 2, height + 4, stated),
        f'<line class="worst" x1="{median:.1f}" x2="{worst:.1f}" y1="{middle:.1f}" y2="{middle:.1f}"/>',
    ]
    for k, (walk, colour, entry) in enumerate(bars):
        end, at = axis.place(entry.score_deg), top + k * _BAR
        parts.append(_bar("fill", colour, (start, end), at + 1, _BAR - 2, f"{walk}: {entry.score_deg:.1f}°"))
        place = f'class="score" x="{_WIDTH - 6}" y="{at + _BAR - 0.5:.1f}"'
        parts.append(f"<text {place}>{entry.score_deg:.1f}</text>")
    return parts


def _bar(kind: str, value: str, ends: tuple[float, float], top: float, height: float, title: str) -> str:
    place = f'x="{ends[0]:.1f}" width="{ends[1] - ends[0]:.1f}" y="{top:.1f}" height="{height}"'
    return f'<rect {kind}="{value}" {place}><title>{escape(title)}</title></rect>'
