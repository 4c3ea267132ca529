"""A study of short trials with faults, and its time beside processes by hand.

The trials are windows of 150 frames of the real walk `functional/walk.c3d`, one file each, with its static trial.
`efficiency`: two processes by hand, each a loop over half of the trials by `marey.open_markers` and
`marey.estimate_bones`, and `marey study --workers 2` (whole command: start, tables and page included), in turn. The
efficiency is the time by hand divided by that of the study. `faults`: four workers, one truncated trial, two workers
killed by SIGKILL at random times, and a disk that becomes full (a file system in memory, which needs the right to mount
one); then the same command on a larger disk; then the same command with the trial repaired. Compared are all files of a
trial but `run.json` and `report.html`, byte by byte, with those by hand.
"""

import argparse
import json
import os
import shutil
import signal
import statistics
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from bench.common import walking_study
from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.io.study.records import StepRecord, read_step_record

BENCH = Bench(
    measures="A study of short trials: killed workers, a full disk and a damaged trial; time beside processes by hand.",
    sources=("src/marey/pipelines/study", "src/marey/io/study"),
    minutes=12,
)
KILLED = 2
"""Number of workers that are killed."""
WITHIN_S = 25.0
"""Time after the first step began within which they are killed [s]."""
SMALL, LARGE = 0.5, 4.0
"""Size of the disk that becomes full, and that of the enlarged one, relative to the results by hand."""
DAMAGED = "S05/walk_1"
"""Name of the damaged trial."""
FAILED = f"the step {walking_study.STEP} failed: "
"""How the program reports a failure, before its reason."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=2, help="number of pairs of runs for the efficiency")
    parser.add_argument("--seed", type=int, default=0)


def run(run: Run) -> None:
    """Write the study, and measure."""
    folder = run.out / "study"
    shutil.rmtree(folder, ignore_errors=True)
    windows = walking_study.write_study(folder, run.shared / "data" / "markers" / "functional", run.arguments.trials)
    run_parts(run, {name: lambda _, part=part: part(run, folder, windows) for name, part in PARTS.items()})


def _efficiency(run: Run, folder: Path, windows: dict[str, tuple[int, int]]) -> None:
    table = run.table(
        "Two workers beside two processes by hand", "run", Column("by hand", "s", 1), Column("study", "s", 1),
        Column("of it its steps", "s", 1), Column("efficiency", "", 3), Column("processors by hand", "s", 1),
        Column("processors study", "s", 1), Column("efficiency of the processors", "", 3), Column("trials that differ"),
        Column("largest memory of a worker", "MB", 0), Column("median of steps", "MB", 0),
        note=f"{len(windows)} trials of {walking_study.WINDOW} frames. Efficiency: time by hand / time of the study; "
        "the same of the times of all processors, which other work on the machine disturbs less.",
    )  # fmt: skip
    for number in range(run.arguments.repeats):
        hand, out = run.out / f"hand{number}", run.out / f"study{number}"
        pair = {"hand": lambda hand=hand: walking_study.processes_by_hand(folder, hand, windows, 2),
                "study": lambda out=out: _timed(folder, out)}  # fmt: skip
        # The second pair runs the other way round, so that a slow change of the machine's load cancels.
        order = list(pair) if number % 2 == 0 else list(reversed(pair))
        used: dict[str, float] = {}
        seconds: dict[str, float] = {}
        for name in order:
            before = _processors()
            seconds[name] = pair[name]()
            used[name] = _processors() - before
        steps = json.loads((out / "run.json").read_text())["timings_s"]["Steps of trials"]
        memory = [float(row["memory_mb"]) for row in walking_study.rows_of(out)]
        differing = walking_study.different(out, hand, list(windows))
        table.row(
            f"{number + 1} ({', '.join(order)})", seconds["hand"], seconds["study"], steps,
            seconds["hand"] / seconds["study"], used["hand"], used["study"], used["hand"] / used["study"],
            len(differing), max(memory), statistics.median(memory),
        )  # fmt: skip


def _processors() -> float:
    """Time that all processors have worked for the ended processes that this one started [s]."""
    used = os.times()
    return used.children_user + used.children_system


def _timed(folder: Path, out: Path) -> float:
    started = time.perf_counter()
    process = walking_study.start_study(folder, out, 2)
    _, text = process.communicate()
    if process.returncode:
        raise RuntimeError(f"The study ended with {process.returncode}: {text}")
    return time.perf_counter() - started


def _faults(run: Run, folder: Path, windows: dict[str, tuple[int, int]]) -> None:
    table = run.table(
        "Faults, four workers", "run of the same command", Column("exit code"), Column("time", "s", 0),
        Column("trials done"), Column("failed"), Column("reasons"), Column("cut off and begun again"),
        Column("trials that differ"),
        note="The damaged trial is one of the failed ones until it is repaired. Exit code 3: too many trials have no "
        "result; 2: no tables. Differences: files of done trials with other bytes than by hand.",
    )  # fmt: skip
    hand = run.out / "hand0"
    if not hand.exists():
        walking_study.processes_by_hand(folder, hand, windows, 2)
    whole = (folder / f"{DAMAGED}.c3d").read_bytes()
    (folder / f"{DAMAGED}.c3d").write_bytes(whole[: len(whole) // 2])
    size = sum(path.stat().st_size for path in hand.rglob("*") if path.is_file())
    with _disk(run.out / "disk", round(SMALL * size)) as disk:
        out = disk / "results"
        _row(run, table, "two workers killed, disk full, one damaged", folder, out, hand, run.arguments.seed)
        subprocess.run(["mount", "-o", f"remount,size={round(LARGE * size)}", str(disk)], check=True)
        _row(run, table, "after the disk was enlarged", folder, out, hand)
        (folder / f"{DAMAGED}.c3d").write_bytes(whole)
        before = {path: path.stat().st_mtime_ns for path in out.glob(f"*/*/{walking_study.STEP}.json")}
        _row(run, table, "after the trial was repaired", folder, out, hand)
        again = sum(path.stat().st_mtime_ns != when for path, when in before.items())
        table.note += f" The last run did {again} step{'s' * (again != 1)}."


@contextmanager
def _disk(place: Path, size: int) -> Iterator[Path]:
    """A file system in memory of a number of bytes."""
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def _row(
    run: Run, table: Table, name: str, folder: Path, out: Path, hand: Path, seed: int | None = None
) -> None:
    """Run the command once; what was printed and recorded is a row."""
    started = time.perf_counter()
    process = walking_study.start_study(folder, out, 4)
    killed = 0 if seed is None else _kill(process, out, np.random.default_rng(seed))
    _, text = process.communicate()
    seconds = time.perf_counter() - started
    records = dict(_records(out))
    done = [trial for trial, record in records.items() if record.state == "done"]
    failures = [line.partition(FAILED)[2] for line in text.splitlines() if FAILED in line]
    reasons = Counter(map(_kind, failures))
    table.row(
        name + (f" ({killed} killed)" if killed else ""), process.returncode, seconds, len(done), len(failures),
        "; ".join(f"{kind}: {count}" for kind, count in sorted(reasons.items())) or "none",
        sum(record.interruptions for record in records.values()), len(walking_study.different(out, hand, done)),
    )  # fmt: skip
    run.report(text.strip().splitlines()[-1] if text.strip() else "")


def _records(out: Path) -> Iterator[tuple[str, StepRecord]]:
    """The readable records by trial."""
    for path in sorted(out.glob(f"*/*/{walking_study.STEP}.json")):
        record = read_step_record(path)
        if record is not None:
            yield path.parent.relative_to(out).as_posix(), record


def _kind(reason: str) -> str:
    """What a reason is about, without names."""
    kinds = {"No space left": "disk full", "ended while": "worker ended", f"{DAMAGED}.c3d": "damaged file"}
    return next((kind for text, kind in kinds.items() if text in reason), reason[:80])


def _kill(process: "subprocess.Popen[str]", out: Path, rng: np.random.Generator) -> int:
    """Kill workers at random times after the first step began; return how many."""
    while process.poll() is None and not _running(out):
        time.sleep(0.02)
    began, killed = time.monotonic(), 0
    for when in np.sort(rng.uniform(0, WITHIN_S, KILLED)):
        time.sleep(max(0.0, began + float(when) - time.monotonic()))
        while process.poll() is None and not (there := _running(out)):
            time.sleep(0.01)
        if process.poll() is None:
            os.kill(there[int(rng.integers(len(there)))], signal.SIGKILL)
            killed += 1
    return killed


def _running(out: Path) -> list[int]:
    """The processes of the steps that run."""
    named = [record.process for _, record in _records(out) if record.state == "running"]
    return [number for number in named if Path(f"/proc/{number}").exists()]


PARTS = {"efficiency": _efficiency, "faults": _faults}
"""The parts by name."""
