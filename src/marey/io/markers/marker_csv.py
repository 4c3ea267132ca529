"""Reading markers from CSV: one column per coordinate below one header line, or the blocks of a Vicon Nexus export."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.documents import read_rows
from marey.io.units import METRES

_COLUMN = re.compile(r"(?P<label>.+?)[ _.:]*[_ .:]\(?(?P<axis>[xyzXYZ])\)?(?:[ _]*[\[(]?(?P<unit>mm|cm|m)[\])]?)?")
"""Name of the column of a coordinate: label, axis and, optionally, unit (`LKNE_x_mm`, `LKNE.X`, `LKNE X (mm)`)."""
_TIME = re.compile(r"time(?:[ _]*[\[(]?s(?:ec(?:onds)?)?[\])]?)?", re.IGNORECASE)
"""Name of the column of times (`time`, `time_s`, `Time (s)`)."""
_BODY_M = (0.1, 3.0)
"""Plausible extent of the markers on a body [m], to infer a unit that the file does not state; chosen by hand."""
_ROUNDED_S = 1.1e-3
"""Tolerance of a time step [s]: many programs round times to a millisecond."""
_REMEDY = (
    "Give columns `time`, `LABEL_x_mm`, `LABEL_y_mm`, `LABEL_z_mm` (or `_m`), or the section Trajectories of a Vicon "
    "Nexus export."
)
"""Remedy for a file without the expected columns."""

RawMarkers = tuple[Sequence[str], Floats, Floats, float, float, str, list[str]]
"""Labels, points (F, M, 3) [m], residuals (F, M) [m], rate [Hz], time of the first frame [s], unit, notes."""


def read_marker_csv(path: Path, unit: str | None) -> RawMarkers:
    """Read a table of markers with commas, semicolons or tabs between its cells.

    Args:
        path: The file. Either one header line with `time` (or `time_s`) and `LABEL_x`, `LABEL_y`, `LABEL_z`, where a
            unit may follow (`LABEL_x_mm`), or the section Trajectories of a Vicon Nexus export.
        unit: mm, cm or m, which overrides the unit in the file. If neither is given, it is inferred from the extent of
            the markers, which should be that of a body.

    Returns:
        Labels, points (F, M, 3) [m], residuals (NaN), rate [Hz], time of the first frame [s], unit, notes.

    Raises:
        FileProblem: The file has no such columns, a cell is not a number, or its times are not equidistant.
    """
    rows = _rows(path)
    blocks = next((n for n, row in enumerate(rows[:12]) if [c.lower() for c in row[2:5]] == ["x", "y", "z"]), None)
    if blocks is not None and blocks >= 2:
        return _from_blocks(path, rows, blocks, unit)
    return _from_columns(path, rows, unit)


def _rows(path: Path) -> list[list[str]]:
    """Split a text into rows of cells without surrounding blanks."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"cannot be read ({error})", _REMEDY) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        raise FileProblem(path, "is empty", _REMEDY)
    middle = lines[len(lines) // 2]
    delimiter = max(",;\t", key=middle.count)
    rows = read_rows(path, lines, _REMEDY, delimiter=delimiter)
    return [[cell.strip() for cell in row] for row in rows]


def _numbers(path: Path, rows: list[list[str]], columns: list[int]) -> Floats:
    """Read columns as numbers; an empty cell is NaN."""
    try:
        cells = [[row[c] if c < len(row) else "" for c in columns] for row in rows]
        return np.array([[float(c) if c else np.nan for c in row] for row in cells]).reshape(-1, len(columns))
    except ValueError as error:
        raise FileProblem(path, f"has a cell that is not a number ({error})", "Correct or export it again.") from error


def _from_columns(path: Path, rows: list[list[str]], unit: str | None) -> RawMarkers:
    """Read a table with one header line."""
    head = rows[0]
    found: dict[str, dict[str, int]] = {}
    units: set[str] = set()
    for n, cell in enumerate(head):
        if (column := _COLUMN.fullmatch(cell)) is not None:
            if column["axis"].lower() in found.get(column["label"], {}):
                raise FileProblem(path, f"has the column {cell} twice", "Give each marker a unique label.")
            found.setdefault(column["label"], {})[column["axis"].lower()] = n
            units |= {column["unit"]} - {None}
    labels = [label for label, axes in found.items() if len(axes) == 3]
    time = next((n for n, cell in enumerate(head) if _TIME.fullmatch(cell)), None)
    if not labels or time is None:
        lacks = "columns of markers" if time is not None else "column of times"
        raise FileProblem(path, f"has no {lacks}", _REMEDY)
    if unit is None and len(units) > 1:
        raise FileProblem(path, f"mixes the units {', '.join(sorted(units))}", "Use one unit for all columns.")
    if len(rows) < 2:
        raise FileProblem(path, "has no row of numbers", _REMEDY)
    points = _numbers(path, rows[1:], [found[label][axis] for label in labels for axis in "xyz"])
    points = points.reshape(len(points), -1, 3)
    rate, start = even_rate(path, _numbers(path, rows[1:], [time])[:, 0])
    unit, notes = (unit or next(iter(units)), []) if unit or units else _infer_unit(path, points)
    return labels, points * METRES[unit], np.full(points.shape[:2], np.nan), rate, start, unit, notes


def even_rate(path: Path, time: Floats) -> tuple[float, float]:
    """Return the rate [Hz] and the first value [s] of equidistant times.

    Args:
        path: The file, for error messages.
        time: (F,) [s].

    Raises:
        FileProblem: There are fewer than two times, one is missing, or a step differs from the median step by more than
            half of it.
    """
    if len(time) < 2 or not np.isfinite(time).all():
        raise FileProblem(path, "has fewer than two times, or missing ones", "Give the time of each row in seconds.")
    steps = np.diff(time)
    usual = float(np.median(steps))
    uneven = np.abs(steps - usual) > 0.5 * abs(usual) + _ROUNDED_S
    if uneven.any() or time[-1] <= time[0]:
        row = int(np.argmax(uneven)) + 2
        remedy = "Write one row per frame, also for frames in which markers are missing."
        raise FileProblem(path, f"has times that are not equidistant (at row {row} of its frames)", remedy)
    rate = (len(time) - 1) / (time[-1] - time[0])
    return float(rate), float(time[0])


def _infer_unit(path: Path, points: Floats) -> tuple[str, list[str]]:
    """Infer the unit from the extent of the markers."""
    seen = points[np.isfinite(points).all(-1).sum(1) > 1]
    extent = float(np.median(np.linalg.norm(np.nanmax(seen, 1) - np.nanmin(seen, 1), axis=-1))) if len(seen) else 0.0
    unit = next((u for u, metres in METRES.items() if _BODY_M[0] <= extent * metres <= _BODY_M[1]), None)
    if unit is None:
        remedy = "Name the columns `LABEL_x_mm`, or give the unit (--unit)."
        raise FileProblem(path, "does not state its unit", remedy)
    return unit, [f"The file does not state its unit; the markers extend over {extent:.4g}, so {unit} is assumed."]


def _from_blocks(path: Path, rows: list[list[str]], axes: int, unit: str | None) -> RawMarkers:
    """Read a Vicon Nexus export: labels, X Y Z, units, then one row per frame."""
    names, first = rows[axes - 1], axes + 1
    stated = next((cell for cell in rows[first] if cell in METRES), None) if first < len(rows) else None
    starts = [n for n in range(2, len(names)) if names[n]]
    body = rows[first + (stated is not None) :]
    end = next((n for n, row in enumerate(body) if not row or not row[0].isdigit()), len(body))
    points = _numbers(path, body[:end], [n + k for n in starts for k in range(3)]).reshape(end, -1, 3)
    try:
        rate = float(rows[axes - 2][0])
    except ValueError as error:
        raise FileProblem(path, "has no rate above its labels", _REMEDY) from error
    unit, notes = (unit or str(stated), []) if unit or stated else _infer_unit(path, points)
    start = (int(body[0][0]) - 1) / rate if end and rate > 0 else 0.0
    labels = [names[n] for n in starts]
    return labels, points * METRES[unit], np.full(points.shape[:2], np.nan), rate, start, unit, notes
