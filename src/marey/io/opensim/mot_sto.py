"""Reading and writing MOT and STO: OpenSim's tables of numbers or orientations over time."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import FileProblem
from marey.geometry import rotations
from marey.io.atomic import replacing
from marey.io.axes import OPENSIM_FROM_WORLD, change_rotation_axes
from marey.io.documents import require_stated_count


@dataclass(frozen=True, eq=False, kw_only=True)
class TimeSeriesTable:
    """A table of values over time."""

    name: str
    """Name of the table in its header."""
    columns: tuple[str, ...]
    """Names of the K columns, without the time."""
    time: Floats
    """(F,) [s]."""
    values: Floats
    """(F, K); NaN where missing. Angles are in degrees if `in_degrees` is true, otherwise in radians."""
    in_degrees: bool = True
    """Whether angles are in degrees."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time", "values")


@dataclass(frozen=True, eq=False, kw_only=True)
class Orientations:
    """Rotations of named bodies over time."""

    names: tuple[str, ...]
    """Names of the S bodies."""
    time: Floats
    """(F,) [s]."""
    rate: float
    """Sampling rate [Hz]."""
    world_from_body: Floats
    """(F, S, 3, 3), in the world's axes (Z up); NaN where missing."""


def write_table(path: Path | str, table: TimeSeriesTable) -> None:
    """Write a MOT or STO with one row per frame, in which a missing number is `nan`.

    Args:
        path: The file.
        table: The table to write.
    """
    head = [
        table.name,
        "version=1",
        f"nRows={len(table.time)}",
        f"nColumns={1 + len(table.columns)}",
        f"inDegrees={'yes' if table.in_degrees else 'no'}",
        "endheader",
        "\t".join(["time", *table.columns]),
    ]
    numbers = np.column_stack([table.time, table.values])
    rows = ["\t".join([f"{row[0]:.6f}", *(f"{v:.8f}" for v in row[1:])]) for row in numbers]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(head + rows) + "\n", encoding="utf-8")


def read_table(path: Path | str) -> TimeSeriesTable:
    """Read a MOT or STO of numbers.

    Args:
        path: The file.

    Returns:
        The table.

    Raises:
        FileProblem: The file has no `endheader`, no column `time`, or a damaged row.
    """
    head, columns, rows = _split(path)
    settings = dict(line.split("=", 1) for line in head if "=" in line)
    try:
        numbers = [[float(c) if c.strip() else np.nan for c in row] for row in rows]
        data = np.array(numbers).reshape(-1, len(columns) + 1)
    except ValueError as error:
        raise FileProblem(path, f"has a damaged row ({error})", "Export the file again.") from error
    degrees = settings.get("inDegrees", "no").strip().lower()
    if degrees not in ("yes", "no"):
        raise FileProblem(path, f"has inDegrees={degrees[:20]}", "It should be yes, or no for radians.")
    return TimeSeriesTable(
        name=head[0], columns=columns, time=data[:, 0], values=data[:, 1:], in_degrees=degrees == "yes"
    )  # fmt: skip


def write_orientations(path: Path | str, orientations: Orientations) -> None:
    """Write a STO of quaternions w,x,y,z in OpenSim's axes, in which a missing one is `nan,nan,nan,nan`.

    Args:
        path: The file.
        orientations: The orientations to write.
    """
    quaternions = rotations.to_quaternion(change_rotation_axes(OPENSIM_FROM_WORLD, orientations.world_from_body))
    head = [
        f"DataRate={orientations.rate:.6f}",
        "DataType=Quaternion",
        "version=3",
        "OpenSimVersion=4.6",
        "endheader",
        "\t".join(["time", *orientations.names]),
    ]
    rows = [
        "\t".join([f"{t:.6f}", *(",".join(f"{v:.9f}" for v in q) for q in row)])
        for t, row in zip(orientations.time, _continuous(quaternions), strict=True)
    ]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(head + rows) + "\n", encoding="utf-8")


def _continuous(quaternions: Floats) -> Floats:
    """Choose the signs of quaternions (F, S, 4) so that each is near the last known one before it."""
    result = np.array(quaternions)
    last = result[0]
    for f in range(1, len(result)):
        flip = (result[f] * last).sum(-1) < 0
        result[f, flip] *= -1
        known = np.isfinite(result[f]).all(-1)
        last = np.where(known[:, None], result[f], last)
    return result


def is_of_quaternions(path: Path | str) -> bool:
    """Return whether the header of a STO declares orientations.

    Raises:
        FileProblem: The file is not a MOT or STO.
    """
    head, _, _ = _split(path)
    return any(line.replace(" ", "").lower() == "datatype=quaternion" for line in head)


def read_orientations(path: Path | str) -> Orientations:
    """Read a STO of quaternions in OpenSim's axes.

    Args:
        path: The file.

    Returns:
        The orientations in the world's axes.

    Raises:
        FileProblem: The file has no `endheader`, no column `time`, or a damaged row.
    """
    head, columns, rows = _split(path)
    settings = dict(line.split("=", 1) for line in head if "=" in line)
    try:
        time = np.array([float(row[0]) for row in rows])
        cells = [[[float(v) for v in c.split(",")] if c.strip() else [np.nan] * 4 for c in row[1:]] for row in rows]
        quaternions = np.array(cells).reshape(len(rows), len(columns), 4)
    except ValueError as error:
        raise FileProblem(path, f"has a damaged row ({error})", "Export the file again.") from error
    try:
        rate = float(settings["DataRate"]) if "DataRate" in settings else 1 / float(np.median(np.diff(time)))
    except (ValueError, ZeroDivisionError) as error:
        raise FileProblem(path, f"has no valid rate ({str(error)[:60]})", "Write DataRate in hertz.") from error
    turn = change_rotation_axes(OPENSIM_FROM_WORLD.T, rotations.from_quaternion(quaternions))
    return Orientations(names=columns, time=time, rate=rate, world_from_body=turn)


def _split(path: Path | str) -> tuple[list[str], tuple[str, ...], list[list[str]]]:
    """Return the lines of the header, the names of the columns after the time, and the cells of the rows."""
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"cannot be read ({error})", "Give a MOT or STO file.") from error
    ends = [i for i, line in enumerate(lines) if line.strip().lower() == "endheader"]
    if not ends or len(lines) < ends[0] + 2:
        raise FileProblem(path, "has no line `endheader` followed by the names of columns", "Give a MOT or STO file.")
    columns = lines[ends[0] + 1].split()
    if columns[:1] != ["time"]:
        raise FileProblem(path, f"has the first column {''.join(columns[:1])!r}", "The first column should be `time`.")
    rows = [line.rstrip("\n").split("\t") for line in lines[ends[0] + 2 :] if line.strip()]
    if any("\t" not in line for line in lines[ends[0] + 2 :] if line.strip()):
        rows = [line.split() for line in lines[ends[0] + 2 :] if line.strip()]
    stated = dict(line.split("=", 1) for line in lines[: ends[0]] if "=" in line)
    require_stated_count(path, "nRows", stated.get("nRows"), len(rows))
    require_stated_count(path, "nColumns", stated.get("nColumns"), len(columns))
    return lines[: ends[0]] or [""], tuple(columns[1:]), rows
