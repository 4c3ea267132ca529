"""Reading of the times of all pictures, which Caliscope stores beside the videos of a recording."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.clocks import Clocks
from marey.errors import FileProblem
from marey.io.calibration.parts import read_text

_FILES = ("timestamps.csv", "frame_time_history.csv")
"""Names of the file, the second one of older versions."""
_CAMERAS = ("cam_id", "port", "camera")
"""Names of the column of cameras, which has their names or numbers."""
_TIMES = ("frame_time", "time_s", "timestamp")
"""Names of the column of times [s]."""
_REMEDY = "It needs a column cam_id, port or camera, and a column frame_time in seconds; --sync off ignores the file."
"""Remedy in the error messages."""
_LONGEST_PAUSES = 10.0
"""Largest duration of a recording, relative to that of its pictures without pauses. Chosen by hand."""
_LEAST_PICTURES = 2
"""Smallest number of pictures of a camera, which define a rate."""


def find_timestamps(folder: Path) -> Path | None:
    """Find the file with the times of all pictures in the folder of a trial.

    Args:
        folder: The folder.

    Returns:
        The file; None if there is none, or if its columns are others.
    """
    for path in (folder / name for name in _FILES):
        if path.is_file():
            header = read_text(path, _REMEDY).split("\n", 1)[0].strip().split(",")
            if _column(header, _CAMERAS) is not None and _column(header, _TIMES) is not None:
                return path
    return None


def _column(header: Sequence[str], names: Sequence[str]) -> int | None:
    cleaned = [part.strip().strip('"').lower() for part in header]
    return next((cleaned.index(name) for name in names if name in cleaned), None)


def read_timestamps(path: Path, cameras: Sequence[str]) -> dict[str, Floats]:
    """Read the times of all pictures.

    Args:
        path: A CSV with one row per picture, in any order of the cameras.
        cameras: The cameras that are used; a camera `cam_1` may be called 1.

    Returns:
        Times (n,) of the pictures of each camera [s], in ascending order.

    Raises:
        FileProblem: A value is not a number, or a camera has no times.
    """
    rows = list(csv.reader(read_text(path, _REMEDY).splitlines()))
    camera, time = _column(rows[0], _CAMERAS), _column(rows[0], _TIMES)
    if camera is None or time is None:
        raise FileProblem(path, "has no column of cameras or of times", _REMEDY)
    found: dict[str, list[float]] = {}
    for number, row in enumerate(rows[1:], 2):
        if not any(part.strip() for part in row):
            continue
        try:
            found.setdefault(_camera_key(row[camera]), []).append(float(row[time]))
        except (ValueError, IndexError) as error:
            raise FileProblem(path, f"has no camera and time in line {number}", _REMEDY) from error
    times = {name: np.sort(np.array(found.get(name, found.get(_camera_key(name), [])))) for name in cameras}
    for name, own in times.items():
        if len(own) < _LEAST_PICTURES or not np.isfinite(own).all():
            raise FileProblem(path, f"has {len(own)} times of '{name}' that are numbers", _REMEDY)
        if np.min(np.diff(own)) <= 0:
            raise FileProblem(path, f"has two pictures of '{name}' at one time", _REMEDY)
        if own[-1] - own[0] > _LONGEST_PAUSES * np.median(np.diff(own)) * len(own):
            wrong = f"has {len(own)} pictures of '{name}' in {own[-1] - own[0]:g} s, with long pauses between them"
            raise FileProblem(path, wrong, _REMEDY)
    return times


def _camera_key(name: str) -> str:
    """Return the number of a camera of Caliscope, or its name."""
    stripped = name.strip().strip('"')
    tail = stripped.removeprefix("cam_").removeprefix("port_")
    return str(int(tail)) if tail.isdecimal() and len(tail) < 10 else stripped


def line_clocks(times: Mapping[str, Floats], rates: Sequence[float]) -> Clocks:
    """Return the clocks that describe the times of the pictures best by an offset and a drift.

    Args:
        times: Times (n,) of the pictures of each camera on one clock [s]; the first camera defines the clock.
        rates: Frame rate of each video [Hz].

    Returns:
        The clocks, with the standard deviations of fitted lines.
    """
    lines = [np.polyfit(np.arange(len(own)) / rate, own, 1) for own, rate in zip(times.values(), rates, strict=True)]
    slope, begin = np.array(lines).T
    errors = [_line_errors(own, rate, line) for own, rate, line in zip(times.values(), rates, lines, strict=True)]
    slope_sd, begin_sd = np.array(errors).T
    others = np.arange(len(times)) > 0
    return Clocks(
        names=tuple(times),
        offset_s=others * (begin - begin[0]) / slope[0],
        drift=others * (slope / slope[0] - 1),
        offset_sd_s=others * np.hypot(begin_sd, begin_sd[0]),
        drift_sd=others * np.hypot(slope_sd, slope_sd[0]),
    )


def _line_errors(times: Floats, rate: float, line: Floats) -> tuple[float, float]:
    """Return the standard deviations of slope and begin of a line through the times."""
    own = np.arange(len(times)) / rate
    variance = np.sum((times - np.polyval(line, own)) ** 2) / max(len(times) - 2, 1)
    spread = np.sum((own - own.mean()) ** 2)
    return float(np.sqrt(variance / spread)), float(np.sqrt(variance * (1 / len(times) + own.mean() ** 2 / spread)))
