"""What further cores gain: the same capture with one core, two, and so on up to those of the machine.

Every capture is a process of its own that finds the compiled kernels of the one before. What is not parallel follows
from the time with several cores by Amdahl's law, and gives the speed-up that more cores would have. The limit of the
machine is the speed-up of captures that have nothing to do with each other: as many as there are cores, each with one
core, at the same time. Cores share their memory and caches, and some of them the units of a physical core.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.process import usable_cores

BENCH = Bench(
    measures="Time of a capture with one core, two, and so on, and the part of it that is not parallel.",
    sources=("src/marey/fit", "src/marey/images", "src/marey/pipelines", "src/marey/process.py"),
    minutes=8,
)
MORE = (4, 8, 16)
"""Numbers of cores for which the speed-up is derived where the machine has fewer."""
CAPTURE = """
import sys, marey
with marey.tuned_process(workers=int(sys.argv[3])):
    marey.capture(sys.argv[1], out=sys.argv[2], frames=(0, int(sys.argv[4])), overlay=False,
                  progress=marey.RecordingProgress())
"""
"""A capture in a process of its own: trial, folder of the results, cores, frames."""


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A capture with a number of cores."""

    wall: float
    """Time from start to end [s]."""
    work: float
    """Processor time of all cores [s]."""
    stages: dict[str, float]
    """Time of each stage [s]."""
    motion: bytes
    """The captured motion, as it was written."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("take", nargs="?", default="walk", help="a take of data/people")
    parser.add_argument("--frames", type=int, default=60, help="frames that are captured")


def command(trial: Path, out: Path, cores: int, frames: int) -> list[str]:
    """Return the command that captures a trial with a number of cores."""
    return [sys.executable, "-c", CAPTURE, str(trial), str(out), str(cores), str(frames)]


def unrelated_speed_up(trial: Path, out: Path, count: int, frames: int, one: float) -> float:
    """Return the speed-up of captures with one core each at the same time, given the time of one of them alone [s]."""
    begin = time.perf_counter()
    started = [subprocess.Popen(command(trial, out / f"unrelated{i}", 1, frames)) for i in range(count)]
    if any(process.wait() for process in started):
        raise subprocess.CalledProcessError(1, CAPTURE)
    return count * one / (time.perf_counter() - begin)


def timed_capture(trial: Path, out: Path, cores: int, frames: int) -> Timed:
    """Capture a trial with a number of cores."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command(trial, out, cores, frames), check=True)
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    work = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    stages = json.loads((out / "run.json").read_text())["timings_s"]
    return Timed(wall=wall, work=work, stages=stages, motion=(out / "motion.npz").read_bytes())


def run(run: Run) -> None:
    """Capture with each number of cores."""
    trial, frames = run.shared / "data" / "people" / run.arguments.take, run.arguments.frames
    counts = [n for n in (1, 2, *MORE) if n <= usable_cores()]
    timed_capture(trial, run.out / "first", counts[-1], frames)  # compiles the kernels
    found = {n: timed_capture(trial, run.out / f"cores{n}", n, frames) for n in counts}
    one, last = found[1], counts[-1]
    table = run.table(
        f"{run.arguments.take}, {frames} frames", "cores", Column("time [s]", "", 1), Column("core time [s]", "", 1),
        Column("speed-up", "", 2), Column("of ideal", "", 2), Column("results equal those with one core"),
    )  # fmt: skip
    for n, each in found.items():
        gain = one.wall / each.wall
        table.row(str(n), each.wall, each.work, gain, gain / n, "yes" if each.motion == one.motion else "no")
    limit = unrelated_speed_up(trial, run.out, last, frames, one.wall)
    table.row(f"{last} (limit of this machine)", last * one.wall / limit, last * one.work, limit, limit / last, "")
    serial = max((last * found[last].wall / one.wall - 1) / (last - 1), 0.0) if last > 1 else 1.0
    for n in MORE:
        if n > last > 1:
            gain = 1 / (serial + (1 - serial) / n)
            table.row(f"{n} (derived)", one.wall / gain, one.work, gain, gain / n, "")
    stages = run.table(
        "Stages", "stage", *(Column(f"{n} cores [s]", "", 1) for n in counts), Column("speed-up", "", 2)
    )  # fmt: skip
    for name, seconds in sorted(one.stages.items(), key=lambda item: -item[1]):
        own = [each.stages.get(name, 0.0) for each in found.values()]
        if seconds >= 0.05:
            stages.row(name, *own, seconds / max(own[-1], 1e-9))
    run.report(f"Load of the machine at the end, mean of a minute: {os.getloadavg()[0]:.1f}.")
