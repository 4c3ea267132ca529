"""The quantities of results: gait parameters, repetitions, segment parameters, and extreme values of angles."""

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.results.repetitions import read_repetitions
from marey.io.study.records import StepValue
from marey.motion.events.curves import side_of, without_side
from marey.motion.events.repetitions import Repetitions
from marey.motion.events.summaries import half_width_of_mean
from marey.motion.motion import MEASURED
from marey.pipelines.gait.repetitions import REPETITIONS_FILE

NORMAL_95 = 1.959964
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""
_SEGMENT_UNITS = {
    "length": "m", "girth_proximal": "m", "girth_middle": "m", "girth_distal": "m", "volume": "l", "mass": "kg",
}  # fmt: skip
"""Parameters of a segment that become rows, with their units; centres and moments of inertia stay in `segments.csv`."""
_ANGLE_UNITS = ("deg", "mm")
"""Units of the columns of `angles.csv`: angles and translations of joints."""


def quantities_of(folder: Path) -> tuple[StepValue, ...]:
    """Return the quantities in the results of a step.

    Args:
        folder: The folder of its results.

    Returns:
        The quantities in the order of the files `repetitions.csv`, `gait.csv`, `segments.csv` and `angles.csv`; those
        of files that do not exist are missing.

    Raises:
        FileProblem: A file is damaged.
    """
    readers = {"gait.csv": _gait, "segments.csv": _segments, "angles.csv": _angles}
    found: list[StepValue] = []
    if (folder / REPETITIONS_FILE).is_file():
        found += _repetitions(read_repetitions(folder / REPETITIONS_FILE))
    for name, read in readers.items():
        path = folder / name
        if path.is_file():
            try:
                with path.open(newline="", encoding="utf-8") as file:
                    found += read(list(csv.DictReader(file)))
            except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
                raise FileProblem(path, f"cannot be read ({error})", "Run the command again.") from error
    return tuple(found)


def _gait(rows: list[dict[str, str]]) -> Iterator[StepValue]:
    for row in rows:
        yield StepValue(
            quantity=row["quantity"], side=row["side"], unit=row["unit"], value=float(row["value"]),
            low=_number(row["low95"]), high=_number(row["high95"]), count=int(row["cycles"]),
        )  # fmt: skip


def _repetitions(found: Repetitions) -> Iterator[StepValue]:
    """Yield the number of repetitions of each kind, and the means of their quantities."""
    for kind in dict.fromkeys(each.kind for each in found):
        chosen = [k for k, each in enumerate(found) if each.kind == kind]
        own = [found.entries[k] for k in chosen]
        number = float(len(own))
        yield StepValue(quantity=f"{kind}_count", side="", unit="", value=number, low=number, high=number)
        yield _mean(f"{kind}_duration", "", "s", [(each.end_s - each.start_s, math.nan) for each in own])
        yield _mean(f"{kind}_depth", "", "m", [(each.depth_m, each.depth_sd_m) for each in own])
        flights = [each.flight for each in own if each.flight is not None]
        if flights:
            yield _mean(f"{kind}_height", "", "m", [(flight.height_m, flight.height_sd_m) for flight in flights])
        for angle, largest in zip(found.angle_names, found.largest_deg[chosen].T, strict=True):
            name, side = _split(angle)
            if np.isfinite(largest).all():
                yield _mean(f"{kind}_{name}_largest", side, "deg", [(value, math.nan) for value in largest])


def _mean(quantity: str, side: str, unit: str, values: Sequence[tuple[float, float]]) -> StepValue:
    """Return the mean of values that have standard deviations."""
    table = np.array(values)
    mean, half = float(table[:, 0].mean()), half_width_of_mean(table[:, 0], table[:, 1])
    return StepValue(
        quantity=quantity, side=side, unit=unit, value=mean, low=mean - half, high=mean + half, count=len(table)
    )


def _segments(rows: list[dict[str, str]]) -> Iterator[StepValue]:
    for row in rows:
        name, side = _split(row["segment"])
        for parameter, unit in _SEGMENT_UNITS.items():
            value, sd = _number(row[f"{parameter}_{unit}"]), _number(row[f"{parameter}_sd_{unit}"])
            # A value that the model holds equal to that of the other side is one measurement, not two.
            if math.isfinite(value) and not row["equal_by_model_to"]:
                yield _with_sd(f"{name}_{parameter}", side, unit, value, sd)
            elif math.isfinite(value) and side == "left":
                yield _with_sd(f"{name}_{parameter}", "both", unit, value, sd)


def _angles(rows: list[dict[str, str]]) -> Iterator[StepValue]:
    rows = [row for row in rows if int(row.get("state") or MEASURED) == MEASURED]
    for column in rows[0] if rows else ():
        stem, _, unit = column.rpartition("_")
        if unit in _ANGLE_UNITS and not stem.endswith("_sd"):
            values = np.array([_number(row[column]) for row in rows])
            sds = np.array([_number(row.get(f"{stem}_sd_{unit}", "")) for row in rows])
            if np.isfinite(values).any():
                yield from _extremes(stem, unit, values, sds)


def _extremes(stem: str, unit: str, values: Floats, sds: Floats) -> Iterator[StepValue]:
    """Yield the greatest and the least value of a curve, and their difference."""
    name, side = _split(stem)
    high, low = int(np.nanargmax(values)), int(np.nanargmin(values))
    yield _with_sd(f"{name}_maximum", side, unit, float(values[high]), float(sds[high]))
    yield _with_sd(f"{name}_minimum", side, unit, float(values[low]), float(sds[low]))
    both = float(np.hypot(sds[high], sds[low]))
    yield _with_sd(f"{name}_range", side, unit, float(values[high] - values[low]), both)


def _with_sd(quantity: str, side: str, unit: str, value: float, sd: float) -> StepValue:
    half = NORMAL_95 * sd
    return StepValue(quantity=quantity, side=side, unit=unit, value=value, low=value - half, high=value + half)


def _split(name: str) -> tuple[str, str]:
    """Return a name without its side, and the side; empty if it has none."""
    return without_side(name), side_of(name) or ""


def _number(text: str) -> float:
    return float(text) if text else float("nan")
