"""Writing of the table of all captured people of a trial."""

import csv
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from marey.io.atomic import replacing


@dataclass(frozen=True, kw_only=True)
class PersonRow:
    """One row of `people.csv`: one person."""

    person: int
    """Number of the person."""
    folder: str
    """Name of the folder with the results."""
    first_frame: int
    """First frame in which the person was found."""
    last_frame: int
    """Last frame in which the person was found."""
    frames_seen: int
    """Number of frames in which the person was found."""
    frames_measured: int = 0
    """Number of frames with a measured pose."""
    stature_m: str = ""
    """Estimated stature [m]; empty without a result, or if the images do not measure it."""
    agreement: str = ""
    """Mean intersection over union of body and silhouettes; empty without a result."""
    problem: str = ""
    """Why the person was not captured; empty otherwise."""


def write_people(path: Path, rows: Sequence[PersonRow]) -> None:
    """Write `people.csv`.

    Args:
        path: The file.
        rows: The people, in the order of their numbers.

    Raises:
        FileProblem: The file cannot be written.
    """
    with replacing(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([column.name for column in fields(PersonRow)])
        table.writerows(astuple(row) for row in rows)
