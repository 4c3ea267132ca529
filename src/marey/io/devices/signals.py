"""Reading the signals of a foreign device: C3D (analog channels and force plates), MOT, STO, TRC and CSV."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import FileProblem
from marey.io.documents import read_rows
from marey.io.markers.c3d import open_c3d, point_unit
from marey.io.markers.c3d_forces import force_plates_in
from marey.io.opensim.mot_sto import read_table
from marey.io.opensim.trc import read_trc
from marey.io.units import METRES

VERTICAL_FORCE = "vertical_force"
"""Name of the sum of the vertical forces of all plates of a C3D [N]."""
LEAST_SAMPLES = 20
"""Files with fewer samples hold no signal. Chosen by hand."""
_TIME = re.compile(r"(?:time(?:stamp)?s?|t)(?:[ _]*[\[(]?(?P<unit>s|sec|seconds|ms|us|µs)[\])]?)?", re.IGNORECASE)
"""Names of the column of times in a table, with its unit; seconds by default."""
_SECONDS = {"ms": 1e-3, "us": 1e-6, "µs": 1e-6}
"""Length of the units of time other than the second [s]."""
_CSV_REMEDY = "Give a table with a header, and a column time_s, time_ms or time_us of the time of each row."
"""Remedy in the error messages about tables."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviceSignals:
    """Signals over the time of the device that recorded them."""

    time: Floats
    """(N,) increasing, on the device's clock [s]."""
    names: tuple[str, ...]
    """K names."""
    values: Floats
    """(N, K) in the file's units; NaN where missing."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time", "values")


def read_signals(path: Path | str) -> DeviceSignals:
    """Read the signals of a device.

    Args:
        path: A C3D (all analog channels, the forces of its plates as `force_plate_1_x` ... [N], and their sum
            `vertical_force`), MOT, STO, TRC (coordinates of the points as `NAME_x` ... [m]) or CSV with a header and a
            column of times.

    Returns:
        The signals.

    Raises:
        FileProblem: The file has another format, is damaged, or holds no signal over time.
    """
    path = Path(path)
    readers = {".c3d": _from_c3d, ".mot": _from_table, ".sto": _from_table, ".trc": _from_trc}
    readers |= dict.fromkeys((".csv", ".tsv", ".txt"), _from_csv)
    if path.suffix.lower() not in readers:
        raise FileProblem(path, "is not a file of signals", "Give a C3D, MOT, STO, TRC or CSV.")
    if not path.is_file():
        raise FileProblem(path, "does not exist", "Give a file of a device's signals.")
    found = readers[path.suffix.lower()](path)
    if not found.names:
        raise FileProblem(path, "has no signals", "Export it with its analog channels.")
    twice = sorted({name for name in found.names if found.names.count(name) > 1})
    if twice:
        raise FileProblem(path, f"has the signal {twice[0]} twice", "Give each signal a name of its own.")
    if len(found.time) < LEAST_SAMPLES:
        raise FileProblem(path, f"has {len(found.time)} samples", f"At least {LEAST_SAMPLES} are needed.")
    back = np.flatnonzero(~(np.diff(found.time) > 0))
    if len(back) or not np.isfinite(found.time).all():
        where = f" (after sample {back[0] + 1})" if len(back) else ""
        raise FileProblem(path, f"has times that do not increase{where}", "Correct or export it again.")
    return found


def _from_c3d(path: Path) -> DeviceSignals:
    c3d = open_c3d(path)
    analog = c3d["parameters"].get("ANALOG", {})
    signals = c3d["data"]["analogs"][0].T
    rate = float((analog["RATE"]["value"] or [0])[0]) if "RATE" in analog else 0.0
    if not signals.size or not rate > 0:
        raise FileProblem(path, "has no analog channels", "Export it with its analog channels.")
    labels = [str(label).strip() for label in analog["LABELS"]["value"]] if "LABELS" in analog else []
    names = [labels[k] if k < len(labels) and labels[k] else f"channel_{k + 1}" for k in range(signals.shape[1])]
    begin = c3d["header"]["points"]["first_frame"] / float((c3d["parameters"]["POINT"]["RATE"]["value"] or [rate])[0])
    plates = force_plates_in(path, c3d, METRES[point_unit(path, c3d)]) if _has_plates(c3d) else ()
    columns = [signals, *(plate.force for plate in plates)]
    names += [f"{plate.name}_{axis}" for plate in plates for axis in "xyz"]
    if plates:
        columns.append(np.sum([plate.force[:, 2] for plate in plates], axis=0)[:, None])
        names.append(VERTICAL_FORCE)
    time = begin + np.arange(len(signals)) / rate
    return DeviceSignals(time=time, names=tuple(names), values=np.concatenate(columns, axis=1))


def _has_plates(c3d: dict) -> bool:  # type: ignore[type-arg]
    group = c3d["parameters"].get("FORCE_PLATFORM", {})
    return "USED" in group and bool((group["USED"]["value"] or [0])[0])


def _from_table(path: Path) -> DeviceSignals:
    table = read_table(path)
    return DeviceSignals(time=table.time, names=tuple(table.columns), values=table.values)


def _from_trc(path: Path) -> DeviceSignals:
    paths = read_trc(path)
    names = tuple(f"{name}_{axis}" for name in paths.names for axis in "xyz")
    return DeviceSignals(time=paths.time, names=names, values=paths.points.reshape(len(paths.time), -1))


def read_columns(path: Path) -> tuple[list[str], list[list[str]]]:
    """Read a table with a header.

    Args:
        path: The file, with commas, semicolons or tabs; lines that begin with # are ignored.

    Returns:
        The names of the columns, and the cells of each row, without surrounding blanks.

    Raises:
        FileProblem: It cannot be read, is empty, or a row has another number of cells than the header.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"cannot be read ({error})", _CSV_REMEDY) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        raise FileProblem(path, "has no rows below a header", _CSV_REMEDY)
    delimiter = max(",;\t", key=lines[0].count)
    rows = [[cell.strip() for cell in row] for row in read_rows(path, lines, _CSV_REMEDY, delimiter=delimiter)]
    for k, row in enumerate(rows[1:], 1):
        if len(row) != len(rows[0]):
            wrong = f"has {len(row)} cells in row {k} below the header, which has {len(rows[0])}"
            raise FileProblem(path, wrong, "Correct or export it again.")
    return rows[0], rows[1:]


def numbers_of(path: Path, name: str, cells: list[str]) -> Floats:
    """Return a column as numbers; an empty cell is NaN.

    Args:
        path: The file, for the message.
        name: Name of the column, for the message.
        cells: N cells.

    Raises:
        FileProblem: A cell is not a number.
    """
    for k, cell in enumerate(cells, 1):
        try:
            float(cell or "nan")
        except ValueError:
            wrong = f"has {cell!r} in the column {name}, row {k} below the header"
            raise FileProblem(path, wrong, "Give numbers with a decimal point.") from None
    return np.array([float(cell or "nan") for cell in cells])


def _from_csv(path: Path) -> DeviceSignals:
    head, rows = read_columns(path)
    times = [(k, match) for k, name in enumerate(head) if (match := _TIME.fullmatch(name)) is not None]
    if len(times) != 1:
        has = f"The columns are {', '.join(head[:8])}."
        raise FileProblem(path, f"has {len(times) or 'no'} columns of times", f"{has} {_CSV_REMEDY}")
    (column, match), columns = times[0], list(zip(*rows, strict=True))
    unit = (match["unit"] or "s").lower()
    time = numbers_of(path, head[column], list(columns[column])) * _SECONDS.get(unit, 1.0)
    others = [k for k in range(len(head)) if k != column]
    values = [numbers_of(path, head[k], list(columns[k])) for k in others]
    stacked = np.stack(values, axis=1) if values else np.zeros((len(time), 0))
    return DeviceSignals(time=time, names=tuple(head[k] for k in others), values=stacked)


def read_event_times(path: Path | str) -> tuple[Floats, Floats]:
    """Read instants of the same events on two clocks.

    Args:
        path: A table with the columns `motion_s` and `device_s` [s]. The columns may have different lengths, with empty
            cells: rows are not pairs.

    Returns:
        The instants on the motion's clock (M,), and on the device's (N,).

    Raises:
        FileProblem: It cannot be read, or lacks one of the columns.
    """
    path = Path(path)
    if not path.is_file():
        raise FileProblem(path, "does not exist", "Give a table with the columns motion_s and device_s (--events).")
    head, rows = read_columns(path)
    if not {"motion_s", "device_s"} <= set(head):
        wrong = f"has the columns {', '.join(head[:8])}"
        raise FileProblem(path, wrong, "Give the columns motion_s and device_s, with the instants in seconds.")
    columns = list(zip(*rows, strict=True))
    motion, device = (numbers_of(path, name, list(columns[head.index(name)])) for name in ("motion_s", "device_s"))
    return motion[np.isfinite(motion)], device[np.isfinite(device)]
