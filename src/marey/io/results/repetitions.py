"""`repetitions.csv`: squats, sitting down and standing up, and jumps of a motion."""

import csv
import math
from pathlib import Path
from typing import get_args

import numpy as np

from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.motion.events.repetitions import Flight, Repetition, RepetitionKind, Repetitions

_HEAD = ("kind", "start_s", "lowest_s", "end_s", "depth_m", "depth_sd_m", "takeoff_s", "landing_s", "flight_sd_s")
"""Columns that describe a repetition."""
_DERIVED = ("jump_height_m", "jump_height_sd_m")
"""Columns that follow from others, and are not read again."""
_LARGEST = "_largest_deg"
"""Ending of the columns with the largest value of an angle."""


def write_repetitions(path: Path | str, repetitions: Repetitions) -> None:
    """Write `repetitions.csv`: one row per repetition; cells of what it does not have are empty.

    Args:
        path: The file.
        repetitions: The repetitions.
    """
    head = [*_HEAD, *_DERIVED, *(f"{name}{_LARGEST}" for name in repetitions.angle_names)]
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        for each, largest in zip(repetitions, repetitions.largest_deg, strict=True):
            numbers = [each.start_s, each.lowest_s, each.end_s, each.depth_m, each.depth_sd_m]
            flight = each.flight
            if flight is None:
                numbers += [math.nan] * 5
            else:
                numbers += [flight.takeoff_s, flight.landing_s, flight.sd_s, flight.height_m, flight.height_sd_m]
            table.writerow(
                [each.kind, *(f"{x:.6f}" if math.isfinite(x) else "" for x in numbers), *map(_degrees, largest)]
            )


def read_repetitions(path: Path | str) -> Repetitions:
    """Read `repetitions.csv` as written by `write_repetitions`.

    Args:
        path: The file.

    Raises:
        FileProblem: The file does not exist or is damaged.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            names = [name for name in rows.fieldnames or () if name.endswith(_LARGEST)]
            table = list(rows)
        entries = tuple(_repetition(row) for row in table)
        largest = np.array([[float(row[name] or "nan") for name in names] for row in table], float)
    except KeyError as error:
        raise FileProblem(path, f"has no column {error}", "Run the command again.") from error
    except (OSError, TypeError, ValueError, csv.Error) as error:
        raise FileProblem(path, f"cannot be read ({error})", "Run the command again.") from error
    return Repetitions(
        entries=entries, angle_names=tuple(name.removesuffix(_LARGEST) for name in names),
        largest_deg=largest.reshape(len(entries), len(names)),
    )  # fmt: skip


def _repetition(row: dict[str, str]) -> Repetition:
    kinds: tuple[RepetitionKind, ...] = get_args(RepetitionKind)
    kind = next((each for each in kinds if each == row["kind"]), None)
    if kind is None:
        raise ValueError(f"{row['kind']!r} is none of {', '.join(kinds)}")
    start, lowest, end, depth, depth_sd = (float(row[name]) for name in _HEAD[1:6])
    flight = None
    if row["takeoff_s"]:
        takeoff, landing, sd = (float(row[name]) for name in _HEAD[6:])
        flight = Flight(takeoff_s=takeoff, landing_s=landing, sd_s=sd)
    return Repetition(
        kind=kind, start_s=start, lowest_s=lowest, end_s=end, depth_m=depth, depth_sd_m=depth_sd, flight=flight
    )


def _degrees(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else ""
