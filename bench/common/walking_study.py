"""A study of short trials: windows of the real walk over force plates, and the same trials done by hand."""

import csv
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

import marey

WINDOW = 150
"""Frames of a trial at 120 Hz; 150 are a little more than one gait cycle."""
SUBJECTS = 10
"""Number of people that the trials are attributed to, in turn."""
STEP = "markers"
"""Name of the step."""
_LAB = """
[segments]
pelvis = ["LASI", "RASI", "LPSI", "RPSI"]
left_thigh = ["LF0?"]
right_thigh = ["RF0?"]
left_shank = ["LT0?"]
right_shank = ["RT0?"]
[landmarks]
RASIS = "RASI"
LASIS = "LASI"
RPSIS = "RPSI"
LPSIS = "LPSI"
left_HJC = "LFEP"
left_KJC = "LFEO"
left_LE = "LKNE"
left_AJC = "LTIO"
left_LM = "LANK"
right_HJC = "RFEP"
right_KJC = "RFEO"
right_LE = "RKNE"
right_AJC = "RTIO"
right_LM = "RANK"
"""
_ONE_THREAD = {
    name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}
_OF_A_RUN = ("run.json", "report.html")
"""Files that state times, and are not compared."""


def write_study(folder: Path, recordings: Path, count: int) -> dict[str, tuple[int, int]]:
    """Write a study of windows of the walk.

    Args:
        folder: The folder of the study.
        recordings: The folder `data/markers/functional`.
        count: Number of trials.

    Returns:
        First frame and end of each trial, by its name.
    """
    folder.mkdir(parents=True)
    shutil.copy(recordings / "static.c3d", folder / "static.c3d")
    (folder / "lab.toml").write_text(_LAB)
    toml = [
        'pattern = "{subject}/{condition}_*.c3d"\n[[steps]]\ncommand = "markers"\nclusters = "lab.toml"\n'
        'static = "static.c3d"\n'
    ]
    windows = {}
    for number in range(count):
        name, first = f"S{number % SUBJECTS + 1:02d}/walk_{number // SUBJECTS + 1}", round(288 * number / count)
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(recordings / "walk.c3d", folder / f"{name}.c3d")
        windows[name] = first, first + WINDOW
        toml.append(f'[trials."{name}"]\nframes = [{first}, {first + WINDOW}]\n')
    (folder / "study.toml").write_text("".join(toml))
    return windows


def by_hand(folder: Path, out: Path, windows: dict[str, tuple[int, int]]) -> None:
    """Do trials one after the other in this process, by the functions that a user calls."""
    with threadpool_limits(1), marey.tuned_process():
        for name, window in windows.items():
            progress = marey.RecordingProgress()
            trial = marey.open_markers(
                folder / f"{name}.c3d", clusters=folder / "lab.toml", static=folder / "static.c3d",
                frames=range(*window), progress=progress,
            )  # fmt: skip
            marey.estimate_bones(trial, out=out / name / STEP, progress=progress)


def processes_by_hand(folder: Path, out: Path, windows: dict[str, tuple[int, int]], count: int) -> float:
    """Do the trials in several processes, each with its share; the time from the start to the end of the last [s]."""
    imports = "import sys; from pathlib import Path; from bench.common.walking_study import by_hand"
    code = f"{imports}; by_hand(Path(sys.argv[1]), Path(sys.argv[2])"
    shares = [dict(list(windows.items())[k::count]) for k in range(count)]
    started = time.perf_counter()
    running = [
        subprocess.Popen([sys.executable, "-c", f"{code}, {share!r})", str(folder), str(out)],
                         env=os.environ | _ONE_THREAD)
        for share in shares
    ]  # fmt: skip
    codes = [process.wait() for process in running]
    if any(codes):
        raise RuntimeError(f"The processes by hand ended with {codes}.")
    return time.perf_counter() - started


def start_study(folder: Path, out: Path, workers: int) -> "subprocess.Popen[str]":
    """Start `marey study`."""
    command = [sys.executable, "-m", "marey", "study", str(folder), "--out", str(out), "--workers", str(workers), "-q"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def rows_of(out: Path) -> list[dict[str, str]]:
    """The rows of `trials.csv`."""
    with (out / "trials.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def different(found: Path, wanted: Path, names: Sequence[str]) -> list[str]:
    """The trials whose results have other files, or other bytes than the same trials done by hand."""
    return [name for name in names if dict(_contents(found / name)) != dict(_contents(wanted / name))]


def _contents(folder: Path) -> Iterator[tuple[str, bytes]]:
    for path in sorted((folder / STEP).rglob("*")):
        if path.is_file() and path.name not in _OF_A_RUN:
            yield path.relative_to(folder).as_posix(), path.read_bytes()
