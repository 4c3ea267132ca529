"""The tables of a study: every quantity of every trial, the trials, and the means over subjects."""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from marey.extras import import_optional
from marey.io.atomic import replacing

OUTLIER, NO_INTERVAL = "outlier", "no interval"
"""Flags of a row of the table: far from the other trials, and without a stated interval."""


@dataclass(frozen=True, kw_only=True)
class StudyRow:
    """One row of `study.csv` and `study.parquet`: one quantity of one side of one trial."""

    trial: str
    """Name of the trial."""
    subject: str
    """The person."""
    condition: str
    """The condition; empty if the study has none."""
    step: str
    """Name of the step that measured it."""
    quantity: str
    """Name of the quantity without side."""
    side: str
    """`left`, `right`, `both`, or empty."""
    unit: str
    """Unit of value and interval."""
    value: float
    low95: float
    """Lower end of the 95 % interval; NaN if unknown."""
    high95: float
    """Upper end of the 95 % interval; NaN if unknown."""
    cycles: int
    """Number of cycles over which the value is a mean; 0 if it is none."""
    flags: str = ""
    """What limits the use of the value, separated by semicolons; empty if nothing does."""


@dataclass(frozen=True, kw_only=True)
class TrialRow:
    """One row of `trials.csv`: one step of one trial."""

    trial: str
    """Name of the trial."""
    subject: str
    """The person."""
    condition: str
    """The condition; empty if the study has none."""
    step: str
    """Name of the step."""
    state: str
    """`done`, `failed`, or `not begun` behind a step that failed."""
    verdict: str
    """`good`, `usable with limits` or `not usable`; empty without a result."""
    reason: str
    """The gravest reason of the verdict, or why the step failed."""
    report: str
    """Path of the report relative to the tables; empty without one."""
    seconds: float
    """Duration of the step [s]."""
    memory_mb: float
    """Largest memory of the worker up to the end of the step [MB]."""
    interruptions: int
    """Number of times that the step was cut off and begun again."""


@dataclass(frozen=True, kw_only=True)
class SubjectRow:
    """One row of `subjects.csv`: one quantity of one side over the trials of a subject in a condition."""

    step: str
    """Name of the step that measured it."""
    quantity: str
    """Name of the quantity without side."""
    side: str
    """`left`, `right`, `both`, or empty."""
    unit: str
    """Unit of mean and interval."""
    condition: str
    """The condition."""
    subject: str
    """The person."""
    trials: int
    """Number of trials."""
    mean: float
    """Mean over the trials."""
    standard_error: float
    """Standard deviation of the mean; NaN if unknown."""
    low95: float
    """Lower end of the 95 % interval of the mean; NaN if unknown."""
    high95: float
    """Upper end of the 95 % interval of the mean; NaN if unknown."""


@dataclass(frozen=True, kw_only=True)
class MeanRow:
    """One row of `means.csv`: one quantity of one side over the subjects of a condition, or a difference of two."""

    step: str
    """Name of the step that measured it."""
    quantity: str
    """Name of the quantity without side."""
    side: str
    """`left`, `right`, `both`, or empty."""
    unit: str
    """Unit of mean, interval and standard deviation."""
    condition: str
    """The condition."""
    minus: str
    """The condition that is subtracted; empty for a mean."""
    kind: str
    """`mean`, `paired difference` within subjects, or `unpaired difference` of two means."""
    subjects: int
    """Number of subjects."""
    trials: int
    """Number of trials."""
    mean: float
    """Mean over the subjects."""
    low95: float
    """Lower end of the 95 % interval of the mean; NaN if unknown."""
    high95: float
    """Upper end of the 95 % interval of the mean; NaN if unknown."""
    between_subjects_sd: float
    """Standard deviation between the subjects, without that of the measurements; NaN for a single subject."""
    weighted: bool
    """Whether the intervals of the values give the weights; otherwise all subjects have the same weight."""


def write_table(path: Path, rows: Sequence[StudyRow | TrialRow | SubjectRow | MeanRow], kind: type[Any]) -> None:
    """Write rows as CSV; cells of unknown numbers are empty.

    Args:
        path: The file.
        rows: The rows.
        kind: Their class, which gives the columns.
    """
    with replacing(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        names = [column.name for column in fields(kind)]
        table.writerow(names)
        table.writerows([_cell(getattr(row, name)) for name in names] for row in rows)


def write_parquet(path: Path, rows: Sequence[StudyRow]) -> None:
    """Write the table as Parquet, with numbers in full precision and null for unknown ones.

    Args:
        path: The file.
        rows: The rows.

    Raises:
        MissingPackage: pyarrow is not installed.
    """
    arrow = import_optional("pyarrow", extra="study", purpose="Parquet tables")
    parquet = import_optional("pyarrow.parquet", extra="study", purpose="Parquet tables")
    types: dict[Any, Any] = {str: arrow.string(), float: arrow.float64(), int: arrow.int32()}
    columns = {
        column.name: arrow.array(_known(getattr(row, column.name) for row in rows), types[column.type])
        for column in fields(StudyRow)
    }
    with replacing(path) as beside:
        parquet.write_table(arrow.table(columns), beside)


def _known(values: Iterable[Any]) -> list[Any]:
    return [None if isinstance(value, float) and math.isnan(value) else value for value in values]


def _cell(value: object) -> str:
    """Write a number with all of its digits; an unknown one is an empty cell."""
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value)
