"""The record of one step of one trial: a small JSON beside the folder of its results."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from marey.io.atomic import replacing, synced_later

StepState = Literal["running", "done", "failed"]
"""How far a step is; "running" also stays after its process was killed."""


@dataclass(frozen=True, kw_only=True)
class StepValue:
    """One quantity of one trial, as a step measured it."""

    quantity: str
    """Name without side, for example `step_length` or `knee_flexion_maximum`."""
    side: str
    """`left`, `right`, `both`, or empty."""
    unit: str
    """Unit of the value and of its interval."""
    value: float
    low: float
    """Lower end of the 95 % interval; NaN if unknown."""
    high: float
    """Upper end of the 95 % interval; NaN if unknown."""
    count: int = 0
    """Number of cycles or repetitions over which the value is a mean; 0 if it is none."""


@dataclass(frozen=True, kw_only=True)
class StepRecord:
    """What is known of a step of a trial."""

    state: StepState
    key: str
    """Hash of version, command, settings and inputs."""
    host: str = ""
    """Computer of the worker."""
    process: int = 0
    """Number of the worker's process."""
    interruptions: int = 0
    """Number of times that the work was cut off before, and begun again."""
    seconds: float = 0.0
    """Duration [s]."""
    memory_mb: float = 0.0
    """Largest memory of the worker up to the end of the step [MB]."""
    message: str = ""
    """Why the step failed, or why it has no usable result."""
    traceback: str = ""
    """Where an error of the program occurred."""
    verdict: str = ""
    """The verdict on the results."""
    reasons: tuple[str, ...] = ()
    """The reasons of the verdict, the gravest first."""
    report: str = ""
    """Path of the report, relative to the folder of the step."""
    values: tuple[StepValue, ...] = field(default=(), repr=False)
    """What was measured."""


_COLUMNS = tuple(each.name for each in fields(StepValue))
"""Names of the numbers of a value, in the order of the record."""


def write_step_record(path: Path, record: StepRecord) -> None:
    """Write the record of a step.

    Args:
        path: The file.
        record: The record.

    Raises:
        NotWritten: The disk is full, or the folder cannot be written to.
    """
    content = asdict(record)
    content["values"] = [[_cell(each[name]) for name in _COLUMNS] for each in content["values"]]
    # A record that a power cut damages is one of a step that is done again.
    with synced_later(path.parent), replacing(path) as beside:
        beside.write_text(json.dumps(content, ensure_ascii=False) + "\n", encoding="utf-8", errors="backslashreplace")


def read_step_record(path: Path) -> StepRecord | None:
    """Read the record of a step.

    Args:
        path: The file.

    Returns:
        The record; None if there is none, or if it is damaged.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        values = tuple(_value(row) for row in content.pop("values"))
        return StepRecord(**{**content, "reasons": tuple(content["reasons"]), "values": values})
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _cell(value: Any) -> Any:
    return None if isinstance(value, float) and value != value else value


def _value(row: Sequence[Any]) -> StepValue:
    named = dict(zip(_COLUMNS, row, strict=True))
    numbers = {name: float("nan") if named[name] is None else float(named[name]) for name in ("value", "low", "high")}
    return StepValue(**{**named, **numbers})
