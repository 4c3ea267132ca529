"""Instants at which the pictures of a take were recorded: from files of timestamps, and from the containers."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.clocks import Clocks
from marey.errors import FileProblem
from marey.io.documents import read_rows
from marey.io.video.video import Clip

TIMESTAMPS_FILES = ("timestamps.csv", "frame_time_history.csv")
"""Names of the file with the instants of the pictures of all cameras, in the folder of a trial; the second one is that
of older versions of Caliscope."""
CAMERA_COLUMNS = ("camera", "cam_id", "port")
"""Names of the column with the camera, or with its number; Caliscope writes the last two."""
TIME_COLUMNS = ("time_s", "frame_time", "timestamp", "time")
"""Names of the column with the instant [s]."""
ORDER_COLUMNS = ("frame_index", "frame", "sync_index")
"""Names of the column by which the pictures of a camera are ordered; without one, the order is that of the rows."""
DIFFERENT_FRAMES = 0.5
"""Difference of the times of two containers, in frames, above which pictures of one number are not of one instant: from
then on a neighbour is nearer."""

_REMEDY = "It should have the columns camera and time_s (in seconds), and one row for each picture of each camera."
"""Remedy in the error messages."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedTimes:
    """The times of the pictures of all cameras, each from the camera's own first picture on."""

    times: tuple[Floats, ...]
    """(F,) ascending times of each camera's pictures [s], from 0."""
    begin_s: Floats | None
    """(C,) instant of each camera's first picture after that of the first camera [s]; None if it is not known."""

    def clocks(self, names: Sequence[str]) -> Clocks | None:
        """Return the clocks of the cameras, if the instants of all of them are on one clock."""
        if self.begin_s is None:
            return None
        zero = np.zeros(len(names))
        return Clocks(names=tuple(names), offset_s=self.begin_s, drift=zero, offset_sd_s=zero, drift_sd=zero)


def recorded_times(folder: Path, names: Sequence[str], clips: Sequence[Clip]) -> RecordedTimes | None:
    """Find the times of the pictures of all cameras.

    Args:
        folder: The trial; its `timestamps.csv`, or `<camera>_timestamps.csv` of each camera, has priority.
        names: The cameras.
        clips: One clip per camera.

    Returns:
        The times; None if there is no such file, and the pictures of one number have equal times in all containers.

    Raises:
        FileProblem: A file of timestamps cannot be used.
    """
    instants = _from_files(folder, names, [clip.count for clip in clips])
    if instants is not None:
        begin = np.array([own[0] for own in instants])
        return RecordedTimes(times=tuple(own - own[0] for own in instants), begin_s=begin - begin[0])
    times = [_of_clip(clip) for clip in clips]
    if all(clip.seconds is None for clip in clips) or any(own is None for own in times):
        return None
    known = [own for own in times if own is not None]
    shortest = min(map(len, known))
    spread = np.ptp([own[:shortest] for own in known], axis=0)
    period = max(float(np.median(np.diff(own))) for own in known)
    if len({len(own) for own in known}) == 1 and spread.max() <= DIFFERENT_FRAMES * period:
        return None
    return RecordedTimes(times=tuple(known), begin_s=None)


def timestamp_files(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the files of timestamps of a trial, that of all cameras or those of each camera."""
    for name in TIMESTAMPS_FILES:
        if (folder / name).is_file():
            return [folder / name]
    return [path for name in names if (path := folder / f"{name}_timestamps.csv").is_file()]


def _of_clip(clip: Clip) -> Floats | None:
    """Return the times (F,) of a clip's pictures [s]; None if not even its rate is known."""
    if clip.seconds is not None:
        return clip.seconds
    return None if clip.rate is None else np.arange(clip.count) / clip.rate


def _from_files(folder: Path, names: Sequence[str], counts: Sequence[int]) -> list[Floats] | None:
    """Return the instants (F,) of each camera's pictures on a common clock [s]; None without any file."""
    files = timestamp_files(folder, names)
    if not files:
        return None
    together = files[0].name in TIMESTAMPS_FILES
    if together:
        found = _of_all_cameras(files[0], names)
    else:
        found = {path.name.removesuffix("_timestamps.csv"): _of_one_camera(path) for path in files}
    where = files[0] if together else folder
    missing = [name for name in names if name not in found]
    if missing:
        raise FileProblem(where, f"has no timestamps of '{missing[0]}'", _REMEDY)
    return [_checked(where, name, found[name], count) for name, count in zip(names, counts, strict=True)]


def _checked(path: Path, name: str, instants: Floats, count: int) -> Floats:
    """Return the instants of a camera, as many as it has pictures."""
    if len(instants) != count:
        wrong = f"has {len(instants)} timestamps of '{name}', whose video has {count} pictures"
        raise FileProblem(path, wrong, "Give one for each picture, or remove the file.")
    if not np.isfinite(instants).all() or not (np.diff(instants) > 0).all():
        wrong = f"has timestamps of '{name}' that are not ascending numbers"
        raise FileProblem(path, wrong, _REMEDY)
    return instants


def _of_all_cameras(path: Path, names: Sequence[str]) -> dict[str, Floats]:
    rows = _rows(path)
    columns = list(rows[0]) if rows else []
    camera, time = (_column(columns, known) for known in (CAMERA_COLUMNS, TIME_COLUMNS))
    order = _column(columns, ORDER_COLUMNS)
    if camera is None or time is None:
        raise FileProblem(path, f"has the columns {', '.join(columns) or 'of an empty file'}", _REMEDY)
    found: dict[str, list[tuple[float, float]]] = {}
    for number, row in enumerate(rows):
        where = number if order is None else _number(path, row[order])
        found.setdefault(_camera_of(row[camera] or "", names), []).append((where, _number(path, row[time])))
    return {name: np.array([instant for _, instant in sorted(own)]) for name, own in found.items()}


def _of_one_camera(path: Path) -> Floats:
    """Read the last column of a table, whose first row may be a heading."""
    rows = [row for row in read_rows(path, _text(path).splitlines(), _REMEDY) if row]
    first = 1 if rows and _is_heading(rows[0]) else 0
    return np.array([_number(path, row[-1]) for row in rows[first:]])


def _is_heading(row: Sequence[str]) -> bool:
    try:
        float(row[-1])
    except ValueError:
        return True
    return False


def _rows(path: Path) -> list[dict[str, str]]:
    rows = [row for row in read_rows(path, _text(path).splitlines(), _REMEDY) if row]
    return [dict(zip_longest(rows[0], row[: len(rows[0])], fillvalue="")) for row in rows[1:]]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileProblem(path, "cannot be read as a table of text", _REMEDY) from error


def _column(columns: Sequence[str], known: Sequence[str]) -> str | None:
    return next((name for name in known if name in columns), None)


def _number(path: Path, text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise FileProblem(path, f"has {text!r} where a number is expected", _REMEDY) from None


def _camera_of(text: str, names: Sequence[str]) -> str:
    """Return the camera that a text names, or whose name ends with the number that it is."""
    if text in names or not text.isdecimal():
        return text
    ends = {name: re.search(r"(\d+)$", name) for name in names}
    # Compared as texts: a damaged file may have more digits than a number can be read from.
    return next((name for name, end in ends.items() if end and end[1].lstrip("0") == text.lstrip("0")), text)
