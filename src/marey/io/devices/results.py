"""Writing and reading a device's clock, and writing its signals at the frames of a motion."""

import csv
import json
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.documents import finite, finite_number, read_json_table, whole_number
from marey.motion.device_clock import DeviceClock

_PPM = 1e-6
"""One part per million."""
_CLOCK_REMEDY = "Give the clock.json that `marey device` wrote."
"""Remedy in messages on a clock that cannot be read."""


def write_device_clock(path: Path | str, clock: DeviceClock, *, method: str) -> None:
    """Write a device's clock.

    Args:
        path: The file.
        clock: The clock.
        method: From what it was estimated.
    """
    content = {
        "offset_s": clock.offset_s, "offset_sd_s": clock.offset_sd_s, "drift_ppm": clock.drift / _PPM,
        "drift_sd_ppm": clock.drift_sd / _PPM, "covariance": clock.covariance.tolist(), "used": clock.used,
        "method": method,
    }  # fmt: skip
    with replacing(path) as beside:
        beside.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read_device_clock(path: Path | str) -> DeviceClock:
    """Read a device's clock that `marey device` wrote.

    Args:
        path: The file.

    Returns:
        The clock.

    Raises:
        FileProblem: The file cannot be read, or is no such file.
    """
    content = read_json_table(path, _CLOCK_REMEDY)
    offset, drift = (finite_number(content.get(name)) for name in ("offset_s", "drift_ppm"))
    covariance = finite(content.get("covariance"), (2, 2))
    used = whole_number(content.get("used"), least=0, greatest=2**53)
    if offset is None or drift is None or covariance is None or used is None:
        raise FileProblem(path, "is not the clock of a device", _CLOCK_REMEDY)
    return DeviceClock(offset_s=offset, drift=drift * _PPM, covariance=covariance, used=used)


def write_device_signals(
    path: Path | str, time: Floats, names: tuple[str, ...], values: Floats, variance: Floats
) -> None:
    """Write signals at the frames of a motion, one row per frame; cells of unknown values are empty.

    Args:
        path: The file.
        time: (F,) of the frames, on the motion's clock [s].
        names: K names.
        values: (F, K) in the units of the device's file.
        variance: (F, K) their variances.
    """
    sd = np.sqrt(variance)
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["time", *(column for name in names for column in (name, f"{name}_sd"))])
        for at, own, spread in zip(time, values, sd, strict=True):
            pairs = (cell for pair in zip(own, spread, strict=True) for cell in pair)
            rows.writerow([f"{at:.6f}", *("" if np.isnan(cell) else f"{cell:.9g}" for cell in pairs)])
