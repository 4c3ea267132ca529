"""Tables of a walk: gait events, spatio-temporal parameters, and their means."""

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.motion.events.curves import CYCLE_POINTS
from marey.motion.events.cycles import GaitCycle, GaitEvent
from marey.motion.events.parameters import QUANTITIES, GaitMeasures
from marey.motion.events.summaries import GaitSummary

_RUN_AGAIN = "Run the command again."
"""Remedy for a damaged table of results."""


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
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
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
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise FileProblem(path, f"cannot be read ({error})", _RUN_AGAIN) from error
    unknown = (float("nan"), float("nan"))
    table = np.array([[numbers.get((cycle, name), unknown) for name in QUANTITIES] for cycle in cycles], float)
    table = table.reshape(len(cycles), len(QUANTITIES), 2)
    return GaitMeasures(cycles=tuple(cycles.values()), values=table[..., 0], sds=table[..., 1])


def read_cycle_csv(path: Path | str) -> dict[str, Floats]:
    """Read the mean curves of `cycles.csv` as written by `write_cycle_csv`.

    Args:
        path: The file.

    Returns:
        The mean (101,) of each quantity, by its name with its unit; NaN where a cell is empty.

    Raises:
        FileProblem: The file does not exist or is damaged.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            head, *rows = list(csv.reader(file))
        values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows], float)
        if values.shape != (CYCLE_POINTS, len(head)) or len(set(head)) < len(head):
            raise ValueError(f"it should have {CYCLE_POINTS} rows of {len(head)} numbers below different names")
    except (OSError, ValueError, csv.Error) as error:
        raise FileProblem(path, f"cannot be read ({error})", _RUN_AGAIN) from error
    ending = "_mean"
    return {name.removesuffix(ending): values[:, k] for k, name in enumerate(head) if name.endswith(ending)}


def _cell(value: float) -> str:
    """Write a number with nine decimals and without trailing zeros; an unknown one is an empty cell."""
    return f"{round(value, 9) + 0.0:.6g}" if math.isfinite(value) else ""


def _write(path: Path | str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        table.writerows(rows)
