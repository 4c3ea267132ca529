"""Reading and writing of the clocks of a take's cameras: sync.json."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from marey.cameras.clocks import Clocks
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.documents import finite_number, read_json

CLOCKS_FILE = "sync.json"
"""Name of the file in the folder of a trial."""
KEYS = ("offset_s", "offset_sd_s", "drift_ppm", "drift_sd_ppm")
"""Numbers of a camera; all but the first are zero if they are missing."""
LARGEST_DRIFT_PPM = 1e5
"""Largest size of a drift [parts per million]; a video of another frame rate has a larger one. Chosen by hand."""

_PPM = 1e-6
"""One part per million."""
_REMEDY = (
    'It should be {"cameras": {"cam02": {"offset_s": 0.012, "offset_sd_s": 0.001, "drift_ppm": 60.0, '
    '"drift_sd_ppm": 20.0}}}, as `marey sync` writes it; --sync off ignores it.'
)
"""Remedy in the error messages."""


def read_clocks(path: Path | str, names: Sequence[str], *, known: Sequence[str] | None = None) -> Clocks:
    """Read the clocks of cameras.

    Args:
        path: The file.
        names: The cameras that are used, the first of which defines the clock of the result.
        known: All cameras of the calibration; those that are used by default.

    Returns:
        The clocks of the cameras that are used.

    Raises:
        FileProblem: The file has another form, an unknown camera, or no clock of a camera that is used.
    """
    path = Path(path)
    known = names if known is None else known
    content = read_json(path, _REMEDY)
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(cameras, dict):
        raise FileProblem(path, "has no table called cameras", _REMEDY)
    unknown = [repr(name) for name in cameras if name not in known]
    if unknown:
        wrong = f"has the unknown camera {', '.join(unknown)}"
        raise FileProblem(path, wrong, f"The cameras of the calibration are {', '.join(known)}.")
    faults = [fault for name, values in cameras.items() for fault in _faults(name, values)]
    if faults:
        raise FileProblem(path, "; ".join(faults), _REMEDY)
    given = {known[0]: {}, **cameras}
    missing = [name for name in names if name not in given]
    if missing:
        reason = _reason(content, missing[0])
        wrong = f"has no clock of '{missing[0]}'{f', because {reason}' if reason else ''}"
        raise FileProblem(path, wrong, "Select the other cameras (--cameras), or ignore the file (--sync off).")
    rows = np.array([[float(given[name].get(key, 0.0)) for key in KEYS] for name in given])
    offset, offset_sd, drift, drift_sd = rows.T
    every = Clocks(
        names=tuple(given), offset_s=offset, offset_sd_s=offset_sd, drift=drift * _PPM, drift_sd=drift_sd * _PPM
    )
    return every.subset(names)


def _reason(content: Mapping[str, Any], camera: str) -> str | None:
    undetermined = content.get("undetermined")
    reason = undetermined.get(camera) if isinstance(undetermined, dict) else None
    return reason if isinstance(reason, str) else None


def _faults(name: str, values: object) -> list[str]:
    """List what is wrong with the entry of a camera, each as the predicate of a sentence."""
    if not isinstance(values, dict):
        return [f"has the camera '{name}' with {values!r}, which should be a table"]
    if "offset_s" not in values:
        return [f"has the camera '{name}' without offset_s"]
    found = []
    for key in KEYS:
        value = finite_number(values.get(key, 0.0))
        if value is None:
            found.append(f"has {key} = {repr(values[key])[:20]} of '{name}', which should be a number")
        elif "sd" in key and value < 0:
            found.append(f"has {key} = {value:g} of '{name}', which should not be negative")
        elif key == "drift_ppm" and abs(value) > LARGEST_DRIFT_PPM:
            found.append(f"has {key} = {value:g} of '{name}', which should be at most {LARGEST_DRIFT_PPM:g} in size")
    return found


def clocks_table(clocks: Clocks) -> dict[str, dict[str, float]]:
    """Return the entries of the cameras in sync.json."""
    columns = (clocks.offset_s, clocks.offset_sd_s, clocks.drift / _PPM, clocks.drift_sd / _PPM)
    rounded = [np.round(column, digits).tolist() for column, digits in zip(columns, (7, 7, 3, 3), strict=True)]
    return {name: dict(zip(KEYS, row, strict=True)) for name, *row in zip(clocks.names, *rounded, strict=True)}


def require_replaceable_clocks(path: Path) -> None:
    """Check that a file for clocks is new, or holds the clocks of an earlier run.

    Args:
        path: The file.

    Raises:
        FileProblem: There is another file of this name.
    """
    if not os.path.lexists(path):
        return
    try:
        table = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        table = None
    if not isinstance(table, dict) or not isinstance(table.get("cameras"), dict):
        raise FileProblem(path, "exists, and does not hold clocks of cameras", "Give another name (--out).")


def write_clocks(path: Path | str, clocks: Clocks, **more: object) -> None:
    """Write the clocks of cameras.

    Args:
        path: The file.
        clocks: The clocks.
        **more: Further entries of the file, of what JSON can hold.

    Raises:
        FileProblem: The file cannot be written.
    """
    text = json.dumps({"cameras": clocks_table(clocks), **more}, indent=2)
    with replacing(path) as beside:
        beside.write_text(text + "\n", encoding="utf-8")
