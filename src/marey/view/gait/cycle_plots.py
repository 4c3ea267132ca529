"""Curves over the gait cycle, left over right, with the events of the feet; and the table of parameters."""

from collections.abc import Mapping, Sequence

import numpy as np

from marey.arrays import Floats
from marey.motion.events.curves import CycleCurves, CycleMark, side_of, without_side
from marey.motion.events.parameters import QUANTITIES
from marey.motion.events.summaries import ASYMMETRY, GaitSummary
from marey.view.pages.curves import COLOURS, CurvePlot, NumberTable, PlotGroup, PlotMark, Trace
from marey.view.pages.problems import readable
from marey.view.pictures.palette import side_colour

_UNITS = {"deg": "°", "mm": " mm"}
"""Unit that a plot shows, by the ending of a name."""
_LEGEND = "Mean over the cycles from one foot strike to the next [%]."
"""What the curves show."""
_BAND_LEGEND = "The band is 1.96 standard deviations between cycles if there are three or more."
"""What the band shows without reference walks."""
_REFERENCE_LEGEND = (
    "Grey: mean of the reference walks, of both sides, with a band of 1.96 standard deviations between them."
)
"""What the band shows with reference walks."""
_MARKS_LEGEND = "Dashed line: the foot leaves the floor; dotted line: the other foot strikes."
"""What the vertical lines show."""
_REFERENCE = "#8b929b"
"""Colour of the reference walks: grey, chosen by eye to stay behind all others."""
_DIGITS = {"m": 3, "s": 3, "m/s": 3, "steps/min": 1, "%": 1, "deg": 1}
"""Digits in the table, by unit."""


def cycle_plots(
    methods: Sequence[tuple[str, CycleCurves]], marks: Sequence[CycleMark] = (), *,
    references: Mapping[str, Floats] | None = None,
) -> PlotGroup:  # fmt: skip
    """Draw mean curves over the cycle: left over right in one plot, or all methods of one quantity.

    Args:
        methods: Names of the methods, or of the walks, with their curves, of the same quantities; the band of the first
            one is drawn.
        marks: Events of the feet in the cycle.
        references: Mean and standard deviation (101, 2) of reference walks, by the name of the quantity without side;
            their band is drawn in place of that of the first method.
    """
    first, known = methods[0][1], references or {}
    axis = np.linspace(0, 100, len(first.mean))
    plots, paired = [], len(methods) == 1 and {"left", "right"} <= set(first.sides)
    counted = not paired and all(curves.counts == first.counts for _, curves in methods)
    for name, columns in _grouped(first, together=len(methods) == 1).items():
        usual = known.get(without_side(first.names[columns[0]]))
        traces = [
            _trace(
                curves, curves.names.index(first.names[k]), label if len(methods) > 1 else _side(first, k) or name,
                colour=COLOURS[number % len(COLOURS)] if len(methods) > 1 else _side_colour(_side(first, k) or None),
                band=number == 0 and usual is None,
            )
            for number, (label, curves) in enumerate(methods) for k in columns if first.names[k] in curves.names
        ]  # fmt: skip
        if usual is not None:
            traces.append(Trace(label="references", colour=_REFERENCE, values=usual[:, 0], sd=usual[:, 1]))
        sides = {first.sides[k] for k in columns}
        lines = [
            PlotMark(at=mark.percent, colour=_side_colour(mark.side), dotted=not mark.own)
            for mark in marks if mark.side in sides
        ]  # fmt: skip
        count = f", {_cycles(max(first.counts[k] for k in columns))}" if counted else ""
        plots.append(
            CurvePlot(
                title=f"{readable(name)}{count}", curves=traces[::-1], axis=axis, marks=lines,
                unit=_UNITS.get(first.names[columns[0]].rpartition("_")[2], ""),
            )
        )  # fmt: skip
    keys = [(label, COLOURS[i % len(COLOURS)]) for i, (label, _) in enumerate(methods)] if len(methods) > 1 else []
    for side in ("left", "right") if paired else ():
        most = max(count for own, count in zip(first.sides, first.counts, strict=True) if own == side)
        keys.append((f"{side}, {_cycles(most)}", _side_colour(side)))
    if known:
        keys.append(("reference walks", _REFERENCE))
    legend = [_LEGEND, _REFERENCE_LEGEND if known else _BAND_LEGEND, *([_MARKS_LEGEND] if marks else [])]
    return PlotGroup(title="Gait cycle", plots=plots, keys=keys, legend=" ".join(legend))


def _cycles(count: int) -> str:
    return f"{count} cycle" if count == 1 else f"{count} cycles"


def _grouped(curves: CycleCurves, *, together: bool) -> dict[str, list[int]]:
    """Return the columns of each plot by its title: both sides of a quantity together, or each alone."""
    plots: dict[str, list[int]] = {}
    for k, name in enumerate(curves.names):
        if curves.counts[k]:
            quantity = name.rpartition("_")[0]
            plots.setdefault(without_side(quantity) if together else quantity, []).append(k)
    return plots


def _side(curves: CycleCurves, k: int) -> str:
    return side_of(curves.names[k]) or ""


def _side_colour(side: str | None) -> str:
    return side_colour(f"{side}_")


def _trace(curves: CycleCurves, k: int, label: str, *, colour: str, band: bool) -> Trace:
    return Trace(label=label, colour=colour, values=curves.mean[:, k], sd=curves.spread[:, k] if band else None)


def gait_table(parameters: Sequence[GaitSummary]) -> NumberTable:
    """Return the table of spatio-temporal parameters: left, right, both, and the difference between the sides."""
    found = {(entry.quantity, entry.side): entry for entry in parameters}
    rows = []
    for quantity, unit in QUANTITIES.items():
        sides = [found.get((quantity, side)) for side in ("left", "right", "both")]
        if not any(sides):
            continue
        difference = found.get((quantity + ASYMMETRY, "both"))
        counts = [str(entry.cycles) if entry else "0" for entry in sides[:2]]
        between = [f"{entry.sd:.{_DIGITS[unit]}f}" if entry and np.isfinite(entry.sd) else "" for entry in sides[2:]]
        rows.append(
            [f"{readable(quantity)} [{unit}]", *map(stated, sides), *between, stated(difference, with_unit=True),
             " + ".join(counts)]
        )  # fmt: skip
    return NumberTable(
        title="Gait parameters",
        head=("quantity", "left", "right", "both", "sd between cycles", "left − right", "cycles (left + right)"),
        rows=rows,
        legend="Mean over the cycles with its 95 % interval, from the variation between cycles (three or more) and the "
        "uncertainty of events and points. Lengths are measured between the places where the heels stand, along and "
        "across the line of the stride; an error of the cameras' scale is not included.",
    )


def stated(entry: GaitSummary | None, *, with_unit: bool = False) -> str:
    """Return a value with half of its interval; an empty text without one.

    Args:
        entry: The quantity.
        with_unit: Whether its unit is written.
    """
    if entry is None:
        return ""
    text = number_with_half(entry.value, entry.high - entry.value, entry.unit)
    return f"{text} {'°' if entry.unit == 'deg' else entry.unit}" if with_unit else text


def number_with_half(value: float, half: float, unit: str) -> str:
    """Return a number with half of its interval, or with its standard deviation, in the digits of a unit.

    Args:
        value: The number.
        half: What follows the sign ±; NaN if it is unknown.
        unit: The unit, which is not written.
    """
    digits = _DIGITS[unit]
    text = f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")  # no minus before a zero
    return text + (f" ± {half:.{digits}f}" if np.isfinite(half) else "")
