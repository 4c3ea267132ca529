"""CSV of markers: a column a coordinate under one header line, or the blocks that Vicon Nexus writes."""

import csv
import re
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.markers.c3d import METRES

_COLUMN = re.compile(r"(?P<label>.+?)[ _.:]*[_ .:]\(?(?P<axis>[xyzXYZ])\)?(?:[ _]*[\[(]?(?P<unit>mm|cm|m)[\])]?)?")
_TIME = re.compile(r"time(?:[ _]*[\[(]?s(?:ec(?:onds)?)?[\])]?)?", re.IGNORECASE)
_BODY_M = (0.1, 3.0)
"""What markers on a body spread over [m], to tell a unit that the file does not say."""
_ROUNDED_S = 1.1e-3
"""Many programs write times to the millisecond."""
_REMEDY = "Give columns time, LABEL_x_mm, LABEL_y_mm, LABEL_z_mm (or _m), or what Vicon Nexus writes as Trajectories."

Raw = tuple[list[str], Floats, Floats, float, float, str, list[str]]


def read_marker_csv(path: Path, unit: str | None) -> Raw:
    """Read a table of markers with commas, semicolons or tabs between its cells.

    Args:
        path: The file. Either one header line with `time` (or `time_s`) and `LABEL_x`, `LABEL_y`, `LABEL_z`, where a
            unit may follow (`LABEL_x_mm`), or the section Trajectories of a Vicon Nexus export.
        unit: mm, cm or m, in place of what the file says. Where nobody says it, it is told by the size of a body.

    Returns:
        Labels, points (F, M, 3) [m], residuals (none), rate [Hz], time of the first frame [s], unit, notes.

    Raises:
        FileProblem: It has no such columns, holds something that is no number, or its times are uneven.
    """
    rows = _rows(path)
    blocks = next((n for n, row in enumerate(rows[:12]) if [c.lower() for c in row[2:5]] == ["x", "y", "z"]), None)
    if blocks is not None and blocks >= 2:
        return _from_blocks(path, rows, blocks, unit)
    return _from_columns(path, rows, unit)


def _rows(path: Path) -> list[list[str]]:
    """Split a text into rows of cells without blank edges."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"cannot be read ({error})", _REMEDY) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        raise FileProblem(path, "is empty", _REMEDY)
    middle = lines[len(lines) // 2]
    between = max(",;\t", key=middle.count)
    return [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=between)]


def _numbers(path: Path, rows: list[list[str]], columns: list[int]) -> Floats:
    """Read some columns as numbers; an empty cell is NaN."""
    try:
        cells = [[row[c] if c < len(row) else "" for c in columns] for row in rows]
        return np.array([[float(c) if c else np.nan for c in row] for row in cells]).reshape(-1, len(columns))
    except ValueError as error:
        raise FileProblem(path, f"holds something that is no number ({error})", "Mend or export it again.") from error


def _from_columns(path: Path, rows: list[list[str]], unit: str | None) -> Raw:
    """Read a table with one header line."""
    head = rows[0]
    found: dict[str, dict[str, int]] = {}
    units: set[str] = set()
    for n, cell in enumerate(head):
        if (column := _COLUMN.fullmatch(cell)) is not None:
            if column["axis"].lower() in found.get(column["label"], {}):
                raise FileProblem(path, f"has the column {cell} twice", "Give each marker a label of its own.")
            found.setdefault(column["label"], {})[column["axis"].lower()] = n
            units |= {column["unit"]} - {None}
    labels = [label for label, axes in found.items() if len(axes) == 3]
    time = next((n for n, cell in enumerate(head) if _TIME.fullmatch(cell)), None)
    if not labels or time is None:
        lacks = "columns of markers" if time is not None else "column of times"
        raise FileProblem(path, f"has no {lacks}", _REMEDY)
    if unit is None and len(units) > 1:
        raise FileProblem(path, f"mixes the units {', '.join(sorted(units))}", "Write all columns in one.")
    points = _numbers(path, rows[1:], [found[label][axis] for label in labels for axis in "xyz"])
    points = points.reshape(len(points), -1, 3)
    rate, start = even_rate(path, _numbers(path, rows[1:], [time])[:, 0])
    unit, notes = (unit or next(iter(units)), []) if unit or units else _unit_of_a_body(path, points)
    return labels, points * METRES[unit], np.full(points.shape[:2], np.nan), rate, start, unit, notes


def even_rate(path: Path, time: Floats) -> tuple[float, float]:
    """Give the rate of even times (F,) [Hz], and the first of them [s].

    Raises:
        FileProblem: There are fewer than two, one is missing, or a step differs from the usual one by half of it.
    """
    if len(time) < 2 or not np.isfinite(time).all():
        raise FileProblem(path, "has times that are missing, or fewer than two", "Give each row its time in seconds.")
    steps = np.diff(time)
    usual = float(np.median(steps))
    uneven = np.abs(steps - usual) > 0.5 * abs(usual) + _ROUNDED_S
    if uneven.any() or time[-1] <= time[0]:
        row = int(np.argmax(uneven)) + 2
        raise FileProblem(path, f"has uneven times (row {row} of its frames)", "Give a row a frame, also in gaps.")
    rate = (len(time) - 1) / (time[-1] - time[0])
    return float(rate), float(time[0])


def _unit_of_a_body(path: Path, points: Floats) -> tuple[str, list[str]]:
    """Tell the unit by the markers' spread, where the file does not say it."""
    seen = points[np.isfinite(points).all(-1).sum(1) > 1]
    spread = float(np.median(np.linalg.norm(np.nanmax(seen, 1) - np.nanmin(seen, 1), axis=-1))) if len(seen) else 0.0
    unit = next((u for u, metres in METRES.items() if _BODY_M[0] <= spread * metres <= _BODY_M[1]), None)
    if unit is None:
        raise FileProblem(path, "does not say its unit", "Name the columns LABEL_x_mm, or say which unit it is.")
    return unit, [f"The file does not say its unit; with markers {spread:.4g} apart it is taken for {unit}."]


def _from_blocks(path: Path, rows: list[list[str]], axes: int, unit: str | None) -> Raw:
    """Read what Vicon Nexus writes: labels, X Y Z, units, then a row a frame."""
    names, first = rows[axes - 1], axes + 1
    said = next((cell for cell in rows[first] if cell in METRES), None) if first < len(rows) else None
    starts = [n for n in range(2, len(names)) if names[n]]
    body = rows[first + (said is not None) :]
    end = next((n for n, row in enumerate(body) if not row or not row[0].isdigit()), len(body))
    points = _numbers(path, body[:end], [n + k for n in starts for k in range(3)]).reshape(end, -1, 3)
    try:
        rate = float(rows[axes - 2][0])
    except ValueError as error:
        raise FileProblem(path, "has no rate above its labels", _REMEDY) from error
    unit, notes = (unit or str(said), []) if unit or said else _unit_of_a_body(path, points)
    start = (int(body[0][0]) - 1) / rate if end and rate > 0 else 0.0
    labels = [names[n] for n in starts]
    return labels, points * METRES[unit], np.full(points.shape[:2], np.nan), rate, start, unit, notes
