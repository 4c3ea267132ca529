"""Tables of a walk: gait events, spatio-temporal parameters, and their means."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.motion.events.curves import CYCLE_POINTS
from marey.motion.events.cycles import GaitCycle, GaitEvent
from marey.motion.events.parameters import QUANTITIES, GaitMeasures
from marey.motion.events.profile import ProfileScore
from marey.motion.events.summaries import GaitSummary

_RUN_AGAIN = "Run the command again."
"""Remedy for a damaged table of results."""
_MEAN, _SPREAD = "_mean", "_between_cycles_sd"
"""Endings of the columns of `cycles.csv`: mean over the cycles, and standard deviation between them."""


def write_events(path: Path | str, events: Sequence[GaitEvent]) -> None:
    """Write `events.csv`: one row per foot strike or foot off, with side, time, source and standard deviation.

    Args:
        path: The file.
        events: Events in the order of time; the cell of an unknown standard deviation is empty.
    """
    rows = [
        [e.kind, e.side or "", f"{e.time:.6f}", e.source, "" if e.sd_s is None else f"{e.sd_s:.6f}"] for e in events
    ]  # fmt: skip
    _write(path, ["event", "side", "time_s", "source", "sd_s"], rows)


def write_event_table(path: Path | str, events: Sequence[GaitEvent]) -> None:
    """Write `events.mot`: one row per time of an event, in OpenSim's format of tables.

    For each kind of event that occurs there is a column such as `left_strike`, with 1 in the rows of its events and 0
    in the others, and `left_strike_sd` with the standard deviation of the time [s]: 0 where there is no event or it is
    unknown, because OpenSim's older readers skip rows with nan.

    Args:
        path: The file.
        events: Events in any order; events at the same microsecond share a row, because OpenSim requires rising times.
    """
    times = sorted({round(event.time, 6) for event in events})
    kinds = sorted({_kind_of(event) for event in events})
    values = np.zeros((len(times), len(kinds), 2))
    for event in events:
        row, column = times.index(round(event.time, 6)), kinds.index(_kind_of(event))
        values[row, column] = 1.0, event.sd_s or 0.0
    columns = tuple(name for kind in kinds for name in (kind, f"{kind}_sd"))
    table = values.reshape(len(times), -1)
    write_table(path, TimeSeriesTable(name="events", columns=columns, time=np.array(times), values=table))


def _kind_of(event: GaitEvent) -> str:
    """Return the column of an event: its side, if known, and its kind."""
    return f"{event.side}_{event.kind}" if event.side else event.kind


def read_event_csv(path: Path | str) -> tuple[GaitEvent, ...]:
    """Read `events.csv` as written by `write_events`; earlier versions have no standard deviations.

    Args:
        path: The file.

    Raises:
        FileProblem: The file does not exist or is damaged.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            return tuple(
                GaitEvent(
                    kind=row["event"], side=row["side"] or None, time=float(row["time_s"]), source=row["source"],
                    sd_s=float(row["sd_s"]) if row.get("sd_s") else None,
                )
                for row in csv.DictReader(file)
            )  # fmt: skip
    except KeyError as error:
        raise FileProblem(path, f"has no column {error}", _RUN_AGAIN) from error
    except (OSError, TypeError, ValueError, csv.Error) as error:
        raise FileProblem(path, f"cannot be read ({error})", _RUN_AGAIN) from error


def write_gait_csv(path: Path | str, summaries: Iterable[GaitSummary]) -> None:
    """Write `gait.csv`: one row per quantity and side, with mean, standard deviation and 95 % interval over the cycles.

    Args:
        path: The file.
        summaries: The quantities; the cell of an unknown number is empty.
    """
    rows = [
        [s.quantity, s.side, s.unit, _cell(s.value), _cell(s.sd), _cell(s.low), _cell(s.high), str(s.cycles)]
        for s in summaries
    ]  # fmt: skip
    _write(path, ["quantity", "side", "unit", "value", "between_cycles_sd", "low95", "high95", "cycles"], rows)


def write_gait_cycles_csv(path: Path | str, measures: GaitMeasures) -> None:
    """Write `gait_cycles.csv`: one row per cycle and quantity, with its value and standard deviation.

    Args:
        path: The file.
        measures: The parameters of the cycles; quantities that were not measured in a cycle have no row.
    """
    each = zip(measures.cycles, measures.values, measures.sds, strict=True)
    rows = [
        [
            str(number), cycle.side or "", f"{cycle.start:.6f}", f"{cycle.end:.6f}",
            "" if cycle.off is None else f"{cycle.off:.6f}", name, unit, _cell(float(value)), _cell(float(sd)),
        ]
        for number, (cycle, values, sds) in enumerate(each, 1)
        for (name, unit), value, sd in zip(QUANTITIES.items(), values, sds, strict=True) if math.isfinite(value)
    ]  # fmt: skip
    _write(path, ["cycle", "side", "start_s", "end_s", "off_s", "quantity", "unit", "value", "sd"], rows)


def read_gait_cycles_csv(path: Path | str) -> GaitMeasures:
    """Read `gait_cycles.csv` as written by `write_gait_cycles_csv`.

    Args:
        path: The file.

    Raises:
        FileProblem: The file does not exist or is damaged.
    """
    cycles: dict[str, GaitCycle] = {}
    numbers: dict[tuple[str, str], tuple[float, float]] = {}
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                cycles[row["cycle"]] = GaitCycle(
                    side=row["side"] or None, start=float(row["start_s"]), end=float(row["end_s"]),
                    off=float(row["off_s"]) if row["off_s"] else None,
                )  # fmt: skip
                numbers[row["cycle"], row["quantity"]] = float(row["value"]), float(row["sd"] or "nan")
    except KeyError as error:
        raise FileProblem(path, f"has no column {error}", _RUN_AGAIN) from error
    except (OSError, TypeError, ValueError, csv.Error) as error:
        raise FileProblem(path, f"cannot be read ({error})", _RUN_AGAIN) from error
    unknown = (float("nan"), float("nan"))
    table = np.array([[numbers.get((cycle, name), unknown) for name in QUANTITIES] for cycle in cycles], float)
    table = table.reshape(len(cycles), len(QUANTITIES), 2)
    return GaitMeasures(cycles=tuple(cycles.values()), values=table[..., 0], sds=table[..., 1])


def write_cycle_csv(path: Path | str, names: Sequence[str], mean: Floats, spread: Floats) -> None:
    """Write `cycles.csv`: one row per percent of the cycle, mean and standard deviation over the cycles.

    Args:
        path: The file.
        names: N names with their units.
        mean: (101, N) mean over the cycles.
        spread: (101, N) standard deviation over the cycles; NaN, of fewer than three cycles, is an empty cell.
    """
    head = ["cycle_percent", *(f"{name}{ending}" for name in names for ending in (_MEAN, _SPREAD))]
    values = np.stack([mean, spread], -1).reshape(len(mean), -1)
    each = zip(np.linspace(0, 100, len(mean)), values, strict=True)
    _write(path, head, ([f"{at:.6f}", *("" if v != v else f"{v:.5f}" for v in cells)] for at, cells in each))


def read_cycle_csv(path: Path | str) -> dict[str, Floats]:
    """Read the mean curves of `cycles.csv` as written by `write_cycle_csv`.

    Args:
        path: The file.

    Returns:
        The mean (101,) of each quantity, by its name with its unit; NaN where a cell is empty.

    Raises:
        FileProblem: The file does not exist or is damaged.
    """
    return {name: columns[:, 0] for name, columns in read_cycle_bands(path).items()}


def read_cycle_bands(path: Path | str) -> dict[str, Floats]:
    """Read the mean curves of `cycles.csv` and their standard deviations between the cycles.

    Args:
        path: The file.

    Returns:
        Mean and standard deviation (101, 2) of each quantity, by its name with its unit; NaN where a cell is empty.

    Raises:
        FileProblem: The file does not exist or is damaged.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            head, *rows = list(csv.reader(file))
        if len(rows) != CYCLE_POINTS or {len(row) for row in rows} != {len(head)} or len(set(head)) < len(head):
            raise ValueError(f"it should have {CYCLE_POINTS} rows of {len(head)} numbers below different names")
        values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows], float)
    except (OSError, ValueError, csv.Error) as error:
        raise FileProblem(path, f"cannot be read ({error})", _RUN_AGAIN) from error
    columns = dict(zip(head, values.T, strict=True))
    unknown = np.full(CYCLE_POINTS, np.nan)
    names = [name.removesuffix(_MEAN) for name in head if name.endswith(_MEAN)]
    return {name: np.stack([columns[name + _MEAN], columns.get(name + _SPREAD, unknown)], 1) for name in names}


def write_profile_csv(path: Path | str, walks: Mapping[str, Sequence[ProfileScore]]) -> None:
    """Write `gait_profile.csv`: one row per walk, angle and side, with the distance from the reference walks.

    Args:
        path: The file.
        walks: The scores of each walk by its name.
    """
    rows = [
        [walk, each.name.replace(" ", "_"), each.side, _cell(each.score_deg), _cell(each.reference_deg),
         _cell(each.reference_worst_deg)]
        for walk, scores in walks.items() for each in scores
    ]  # fmt: skip
    _write(path, ["walk", "angle", "side", "score_deg", "references_median_deg", "references_largest_deg"], rows)


def write_gait_comparison_csv(
    path: Path | str, walks: Mapping[str, Sequence[GaitSummary]], references: Mapping[str, tuple[float, float]]
) -> None:
    """Write `gait_parameters.csv`: one row per walk, quantity and side, beside what the reference walks have.

    Args:
        path: The file.
        walks: The quantities of each walk by its name.
        references: Mean and standard deviation over the reference walks, of quantities of both sides.
    """
    unknown = (math.nan, math.nan)
    rows = [
        [walk, s.quantity, s.side, s.unit, _cell(s.value), _cell(s.low), _cell(s.high), str(s.cycles),
         *map(_cell, references.get(s.quantity, unknown))]
        for walk, summaries in walks.items() for s in summaries
    ]  # fmt: skip
    head = [
        "walk",
        "quantity",
        "side",
        "unit",
        "value",
        "low95",
        "high95",
        "cycles",
        "references_mean",
        "references_sd",
    ]
    _write(path, head, rows)


def _cell(value: float) -> str:
    """Write a number with nine decimals and without trailing zeros; an unknown one is an empty cell."""
    return f"{round(value, 9) + 0.0:.6g}" if math.isfinite(value) else ""


def _write(path: Path | str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        table.writerows(rows)
