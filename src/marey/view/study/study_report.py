"""The page of a study: what became of each trial, means over subjects, differences, outliers and curves."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import numpy as np

from marey.arrays import Floats
from marey.io.atomic import replacing
from marey.io.study.tables import NO_INTERVAL, OUTLIER, MeanRow, StudyRow, SubjectRow, TrialRow
from marey.motion.events.curves import side_of
from marey.view.pages.curves import COLOURS, CurvePlot, CurvesContent, NumberTable, PlotGroup, Trace, curves_data
from marey.view.pages.html import PageHead, rendered
from marey.view.pages.problems import readable
from marey.view.svg.dot_plots import DotPlot, dot_plot
from marey.wording import count_of, listed

_OPEN_PLOTS = 12
"""Number of plots of quantities that are shown at once; the others are folded. Chosen by hand: two screens."""
_LONGEST_REASON = 300
"""Largest length of the reason in the table of trials [characters]; the report has all of it. Chosen by hand."""
_SHOWN_NAMES = 8
"""Number of names that a note writes out; chosen by hand."""
_MOST_OUTLIERS = 200
"""Number of outliers that the page lists at most; the table has all of them. Chosen by hand."""
_FILES = {
    "study.csv, study.parquet": "every quantity of every trial, with interval and flags",
    "trials.csv": "state, verdict, reason, time and memory of each step of each trial",
    "subjects.csv, means.csv": "means over the trials of a subject; means over subjects, and differences of conditions",
    "run.json": "version, settings, times",
}
"""Files beside the page and their content."""
_MEANING = {
    "Mean over subjects": "The trials of a subject are averaged first, then the subjects. Weights are inverse "
    "variances: that of the measurement, as its interval states it, plus the variance between the true values, which "
    "is estimated by moments (DerSimonian and Laird). If a value has no interval, all values have the same weight.",
    "95 % interval": "Of the mean, by Hartung and Knapp with Student's t. It contains the variation between subjects "
    "and the uncertainty of the measurements, but not errors that all trials share, such as a wrong scale of the "
    "cameras.",
    "SD between subjects": "Standard deviation of the true values, without that of the measurements.",
    "Difference": "Paired: the mean of the differences within the subjects who have both conditions. Unpaired: the "
    "difference of the means of different people. Intervals are not widened for the number of comparisons: of twenty "
    "differences that are zero, one excludes zero by chance.",
    "Outlier": "A value farther from the median of its condition than 3.5 standard deviations, of a robust spread "
    "and its own uncertainty together. It is marked and not removed.",
    "Maximum, minimum, range": "Extreme values of a curve over the whole trial. The interval is that of the single "
    "frames; the more noise and frames, the farther out are extreme values.",
    "Verdict": "How far the results of a trial can be used. Values of results that are not usable are in the table, "
    "but not in the means.",
}
"""Explanations of the terms on the page."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StudyCurve:
    """A curve over the gait cycle of one condition."""

    name: str
    """Name with side and unit, for example `left_knee_flexion_deg`."""
    condition: str
    """The condition; empty if the study has none."""
    mean: Floats
    """(101,) mean over the subjects."""
    between_sd: Floats
    """(101,) standard deviation between the subjects; NaN for fewer than two."""
    subjects: int
    """Number of subjects."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StudyContent:
    """Content of the page."""

    title: str
    head: PageHead
    trials: Sequence[TrialRow]
    rows: Sequence[StudyRow]
    subjects: Sequence[SubjectRow]
    means: Sequence[MeanRow]
    curves: Sequence[StudyCurve] = ()
    settings: Mapping[str, object] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)
    reference: str | None = None
    """The condition with which others are compared."""


@dataclass(frozen=True, kw_only=True)
class _TrialLine:
    """One line of the table of trials."""

    trial: str
    subject: str
    condition: str
    step: str
    state: str
    mark: str
    """Class of its mark: `good`, `caution`, `problem` or `note`."""
    reason: str
    address: str
    """Address of the report, relative to the page; empty without one."""
    seconds: str


def write_study_report(path: Path, content: StudyContent) -> None:
    """Write study.html.

    Args:
        path: The file.
        content: The content of the page.
    """
    page = CurvesContent(
        kind="Study", title=content.title, time=np.zeros(1), head=content.head, tiles=_tiles(content),
        notes=list(_notes(content)),
        tables=[table for table in (_means(content), _differences(content), _outliers(content)) if table.rows],
        groups=_curve_groups(content.curves), settings=content.settings, timings=content.timings, files=_FILES,
        meaning=_MEANING,
    )  # fmt: skip
    plots = _plots(content)
    text = rendered(
        "study.html", page, data=curves_data(page, 1), trials=_lines(content.trials), plots=plots[:_OPEN_PLOTS],
        more_plots=plots[_OPEN_PLOTS:], has_conditions=any(row.condition for row in content.trials),
    )  # fmt: skip
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")


def _tiles(content: StudyContent) -> list[tuple[str, str, str]]:
    rows = content.trials
    trials = {row.trial for row in rows}
    failed = {row.trial for row in rows if row.state != "done"}
    verdicts = Counter(row.verdict for row in rows if row.verdict)
    levels = ", ".join(f"{verdicts[level]} {level}" for level in ("good", "usable with limits", "not usable"))
    seconds = sum(row.seconds for row in rows)
    conditions = sorted({row.condition for row in rows if row.condition})
    named_conditions = count_of(len(conditions), "condition") if conditions else ""
    outliers = sum(OUTLIER in row.flags for row in content.rows)
    return [
        ("trials", f"{len(trials)}", f"{len(trials) - len(failed)} complete, {len(failed)} not"),
        ("subjects", f"{len({row.subject for row in rows})}", named_conditions),
        ("results", f"{sum(verdicts.values())}", levels),
        ("quantities", f"{len(content.rows)}", count_of(outliers, "outlier")),
        ("time of all steps", _duration(seconds), f"{seconds / max(len(rows), 1):.1f} s per step"),
    ]


def _notes(content: StudyContent) -> Iterator[str]:
    again = [row for row in content.trials if row.interruptions and row.state == "done"]
    if again:
        names = listed((row.trial for row in again), most=_SHOWN_NAMES)
        were = "was" if len(again) == 1 else "were"
        cut_off = f"{count_of(len(again), 'step')} {were} cut off by the end of a worker or of the study"
        yield f"{cut_off}, and then finished: {names}."
    without = dict.fromkeys(row.quantity for row in content.rows if NO_INTERVAL in row.flags)
    if without:
        names = listed(map(readable, without), most=_SHOWN_NAMES)
        yield f"Some values have no interval: {names}. There, all values count equally in the means."


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


_MARKS = {"good": "good", "usable with limits": "caution", "not usable": "problem"}
"""Class of the mark of a verdict."""
_ORDER = ("problem", "caution", "note", "good")
"""Order of the lines of the table: what needs attention first."""


def _lines(rows: Sequence[TrialRow]) -> list[_TrialLine]:
    lines = [
        _TrialLine(
            trial=row.trial, subject=row.subject, condition=row.condition, step=row.step,
            state=row.verdict or row.state, reason=_shortened(row.reason),
            mark="problem" if row.state == "failed" else _MARKS.get(row.verdict, "note"),
            address=quote(row.report), seconds=f"{row.seconds:.1f}",
        )
        for row in rows
    ]  # fmt: skip
    return sorted(lines, key=lambda line: _ORDER.index(line.mark))


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST_REASON else f"{text[: _LONGEST_REASON - 1].rstrip()}…"


def _means(content: StudyContent) -> NumberTable:
    """Return the table of means: one row per quantity and side, one column per condition."""
    means = [row for row in content.means if not row.minus]
    conditions = sorted({row.condition for row in means})
    several = len({row.step for row in means}) > 1
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for row in means:
        key = (_title(row, several), row.side)
        spread = f"; SD {_number(row.between_subjects_sd, _digits(row))}" if row.subjects > 1 else ""
        people = f"{count_of(row.subjects, 'subject')}, {count_of(row.trials, 'trial')}"
        star = "" if row.weighted else " *"
        found.setdefault(key, {})[row.condition] = f"{_interval(row)}{star} ({people}{spread})"
    equal = any(not row.weighted for row in means)
    star = " * all values with the same weight, because some have no interval." if equal else ""
    return NumberTable(
        title="Means over subjects", head=("quantity", "side", *(name or "all" for name in conditions)),
        rows=[[*key, *(cells.get(name, "") for name in conditions)] for key, cells in found.items()],
        text_columns=tuple(range(2 + len(conditions))),
        legend="Mean with its 95 % interval, number of subjects and trials, and standard deviation between subjects."
        + star,
    )  # fmt: skip


def _differences(content: StudyContent) -> NumberTable:
    rows = [row for row in content.means if row.minus]
    several = len({row.step for row in rows}) > 1
    clear = [row.low95 > 0 or row.high95 < 0 for row in rows]
    exclude = "excludes" if sum(clear) == 1 else "exclude"
    known = f"{sum(clear)} of {count_of(len(rows), 'interval')} {exclude} zero"
    return NumberTable(
        title="Differences between conditions",
        head=("quantity", "side", "conditions", "difference with 95 % interval", "excludes zero", "kind", "subjects"),
        rows=[
            [_title(row, several), row.side, f"{row.condition} − {row.minus}", _interval(row), "yes" if own else "",
             row.kind, str(row.subjects)]
            for row, own in zip(rows, clear, strict=True)
        ],
        text_columns=(0, 1, 2, 3, 4, 5),
        legend=f"{known}; about {0.05 * len(rows):.0f} would by chance if nothing differed.",
    )  # fmt: skip


def _outliers(content: StudyContent) -> NumberTable:
    rows = [row for row in content.rows if OUTLIER in row.flags]
    shown = rows[:_MOST_OUTLIERS]
    more = f" The first {len(shown)} of {len(rows)}." if len(shown) < len(rows) else ""
    return NumberTable(
        title="Outliers", head=("trial", "quantity", "side", "value with 95 % interval", "condition"),
        rows=[
            [row.trial, f"{readable(row.quantity)} [{row.unit}]", row.side, _interval(row), row.condition]
            for row in shown
        ],
        text_columns=(0, 1, 2, 3, 4), legend=f"Far from the other trials of the condition; marked, not removed.{more}",
    )  # fmt: skip


def _title(row: MeanRow, several: bool) -> str:
    step = f", {row.step}" if several else ""
    return f"{readable(row.quantity)} [{row.unit}]{step}"


def _interval(row: MeanRow | StudyRow) -> str:
    value = row.mean if isinstance(row, MeanRow) else row.value
    digits = _digits(row)
    if not math.isfinite(row.low95):
        return _number(value, digits)
    return f"{_number(value, digits)} [{_number(row.low95, digits)}, {_number(row.high95, digits)}]"


def _digits(row: MeanRow | StudyRow) -> int:
    """Return the number of decimals that shows two digits of the interval."""
    half = 0.5 * (row.high95 - row.low95)
    if not math.isfinite(half) or half <= 0:
        return 3
    return min(max(0, 1 - math.floor(math.log10(half))), 4)


def _number(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−") if math.isfinite(value) else "unknown"


def _plots(content: StudyContent) -> list[DotPlot]:
    """Return a plot of each quantity, all sides in one."""
    means = [row for row in content.means if not row.minus]
    several = len({row.step for row in means}) > 1
    groups: dict[tuple[str, str, str], list[MeanRow]] = {}
    for row in means:
        groups.setdefault((row.step, row.quantity, row.unit), []).append(row)
    people: dict[tuple[str, str, str], list[SubjectRow]] = {}
    for each in content.subjects:
        people.setdefault((each.step, each.quantity, each.unit), []).append(each)
    drawn = [dot_plot(_title(group[0], several), group, people.get(key, [])) for key, group in groups.items()]
    return [plot for plot in drawn if plot is not None]


def _curve_groups(curves: Sequence[StudyCurve]) -> list[PlotGroup]:
    """Return the plots over the cycle, one group per side: all conditions of a quantity in one plot."""
    conditions = sorted({curve.condition for curve in curves})
    colours = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(conditions)}
    most = {name: max(curve.subjects for curve in curves if curve.condition == name) for name in conditions}
    keys = [(f"{name or 'all'}, {count_of(most[name], 'subject')}", colours[name]) for name in conditions]
    found = []
    for side, heading in (("left", "Left"), ("right", "Right"), (None, "Other")):
        own = [curve for curve in curves if side_of(curve.name) == side]
        names = sorted({curve.name for curve in own})
        plots = [_curve_plot(name, [curve for curve in own if curve.name == name], colours) for name in names]
        found.append(
            PlotGroup(
                title=f"{heading}: curves over the gait cycle", plots=plots, keys=keys,
                legend="Mean over the subjects over the cycle [%]; the band is 1.96 standard deviations between them.",
            )
        )  # fmt: skip
    return [group for group in found if group.plots]


def _curve_plot(name: str, curves: Sequence[StudyCurve], colours: Mapping[str, str]) -> CurvePlot:
    stem, _, unit = name.rpartition("_")
    traces = [
        Trace(
            label=curve.condition or "mean", colour=colours[curve.condition], values=curve.mean, sd=curve.between_sd
        )
        for curve in curves
    ]  # fmt: skip
    side = side_of(name)
    bare = stem.removeprefix(f"{side}_") if stem.startswith(f"{side}_") else stem[:-2] if side else stem
    axis = np.linspace(0, 100, len(curves[0].mean))
    return CurvePlot(
        title=readable(bare), curves=traces, axis=axis, unit="°" if unit == "deg" else f" {unit}"
    )
