"""Time and memory of whole captures of recordings of hundreds to thousands of frames.

The frames of the example that show the person are played forwards and backwards until the recording is long enough, in
images of half the width and height. Each capture is a process of its own; its memory is the largest that it and its
worker processes occupied together, sampled five times a second, and that of a stage the one of the first process alone.
The exponent is that of the core time against the number of frames, from one length to the next: 1 if it grows as the
frames do, less as long as the start and other steps that are independent of the length matter.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tests.pipelines.capture.reach import EMPTY, copy_half_trial

import marey
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.video.video_writer import VideoWriter

BENCH = Bench(
    measures="Time and memory of captures against the number of frames.",
    sources=("src/marey/fit", "src/marey/images", "src/marey/io/video", "src/marey/pipelines"),
    minutes=15,
    data=False,
)
CAPTURE = """
import json, sys
from bench.speed.long_captures import capture_with_memory
print(json.dumps(capture_with_memory(sys.argv[1], sys.argv[2])))
"""
"""A capture in a process of its own: trial, folder of the results. It prints a JSON object."""
_SAMPLED_S = 0.2
"""Time between two measurements of the memory [s]."""
_SHORTEST_STAGE = 1.0
"""Stages that are shorter than this in every capture get no row in the table of stages [s]."""


@dataclass(frozen=True, kw_only=True)
class LongCapture:
    """What a capture took."""

    wall: float
    """Time from start to end [s]."""
    work: float
    """Processor time of all cores [s]."""
    memory: float
    """Largest memory of the process and those that it has started, together [GB]."""
    measured: float
    """Share of the frames with a pose."""
    stages: dict[str, tuple[float, float]]
    """Time [s] and largest memory so far [GB] at the end of each stage, in their order."""


class MemoryProgress(marey.RecordingProgress):
    """Records the largest memory of the process at the end of each stage, and prints it on the error stream."""

    def __init__(self) -> None:
        super().__init__()
        self.memory: dict[str, float] = {}
        """Largest memory of the process at the end of each stage [GB]."""

    @contextmanager
    def _show(self, name: str, total: int | None, done: int) -> Iterator[Callable[[int], None]]:
        """Record the memory when the stage ends."""
        yield lambda number: None
        self.memory[name] = largest_memory()
        print(f"{name}: {self.memory[name]:.3f} GB", file=sys.stderr, flush=True)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("frames", nargs="*", type=int, default=[300, 1000, 3000, 6000], help="lengths, shortest first")


def run(run: Run) -> None:
    """Capture recordings of each length."""
    table = run.table(
        "Captures of four cameras, 320 x 240 px", "frames", Column("time", "s", 0), Column("core time", "s", 0),
        Column("frames per second", "", 1), Column("memory", "GB", 2), Column("frames with a pose", "", 3),
        Column("exponent of the core time", "", 2),
    )  # fmt: skip
    captured(lengthened(run.out / "warm", 30), run.out / "warm_results")  # compiles the kernels
    captures: dict[int, LongCapture] = {}
    for count in run.arguments.frames:
        found = captured(lengthened(run.out / f"frames{count}", count), run.out / f"results{count}")
        exponent = None
        if captures:
            last, before = list(captures.items())[-1]
            exponent = np.log(found.work / before.work) / np.log(count / last)
        table.row(str(count), found.wall, found.work, count / found.wall, found.memory, found.measured, exponent)
        captures[count] = found
    tabulate_stages(run, captures)
    run.report(f"Load of the machine at the end, mean of a minute: {os.getloadavg()[0]:.1f}.")


def tabulate_stages(run: Run, captures: dict[int, LongCapture]) -> None:
    """Write the time of each stage, and the largest memory up to its end, of each length."""
    columns = [
        column
        for count in captures
        for column in (Column(f"time of {count} frames", "s", 0), Column(f"memory of {count} frames", "GB", 2))
    ]
    table = run.table("Stages: their time and the largest memory of the process up to their end", "stage", *columns)
    for name in {name: None for found in captures.values() for name in found.stages}:
        figures = [found.stages.get(name, (0.0, None)) for found in captures.values()]
        if max(seconds for seconds, _ in figures) >= _SHORTEST_STAGE:
            table.row(name, *(value for figure in figures for value in figure))


def lengthened(folder: Path, count: int) -> Path:
    """Write the example at half size with a number of frames, the frames forwards and backwards in turn."""
    if folder.exists():  # by an earlier run of the same commit
        return folder
    unfinished = folder.with_name(f"{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    copy_half_trial(unfinished)
    for path in sorted(unfinished.glob("*.mp4")):
        film = cv2.VideoCapture(str(path))
        rate, images = film.get(cv2.CAP_PROP_FPS), []
        while (read := film.read())[0]:
            images.append(np.asarray(read[1], np.uint8))
        film.release()
        shown = images[EMPTY:]
        turn = [*shown, *shown[-2:0:-1]]
        height, width = shown[0].shape[:2]
        with VideoWriter(path, (width, height), rate=rate) as writer:
            for k in range(count):
                writer.add(turn[k % len(turn)])
    return unfinished.rename(folder)


def captured(trial: Path, out: Path) -> LongCapture:
    """Capture a trial in a process of its own."""
    begin = time.perf_counter()
    command = [sys.executable, "-c", CAPTURE, str(trial), str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        memory = 0.0
        while process.poll() is None:
            memory = max(memory, memory_of_family(process.pid))
            time.sleep(_SAMPLED_S)
        output = process.stdout.read() if process.stdout is not None else ""
    wall = time.perf_counter() - begin
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    printed = json.loads(output.splitlines()[-1])
    with np.load(out / "motion.npz") as motion:
        measured = float(np.mean(motion["state"] == 1))
    return LongCapture(wall=wall, measured=measured, memory=memory, **printed)


def memory_of_family(process: int) -> float:
    """Return the memory that a process and those that it has started occupy, shared parts counted once [GB]."""
    total = 0.0
    with suppress(OSError):  # processes end at any time
        for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                total += 1024 * float(line.split()[1]) / 1e9
        for task in Path(f"/proc/{process}/task").iterdir():
            total += sum(memory_of_family(int(child)) for child in (task / "children").read_text().split())
    return total


def capture_with_memory(trial: str, out: str) -> dict[str, object]:
    """Capture a trial in this process; return the processor time [s], and time and memory of the stages."""
    progress = MemoryProgress()
    with marey.tuned_process():
        marey.capture(trial, out=out, overlay=False, progress=progress)
    used = resource.getrusage(resource.RUSAGE_SELF)
    stages = {name: (progress.timings[name], memory) for name, memory in progress.memory.items()}
    copies = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"work": sum(each.ru_utime + each.ru_stime for each in (used, copies)), "stages": stages}


def largest_memory() -> float:
    """Return the largest memory that this process occupied so far [GB]."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e9
