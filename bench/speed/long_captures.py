"""Time and memory of whole captures of recordings of hundreds to thousands of frames.

The frames of the example that show the person are played forwards and backwards until the recording is long enough, in
images of half the width and height. Each capture is a process of its own; its memory is the largest that it occupied.
The exponent is that of the core time against the number of frames, from one length to the next: 1 if it grows as the
frames do, less as long as the start and other steps that are independent of the length matter.
"""

import argparse
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tests.pipelines.capture.reach import EMPTY, copy_half_trial

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
import resource, sys, marey
with marey.tuned_process():
    marey.capture(sys.argv[1], out=sys.argv[2], overlay=False, progress=marey.RecordingProgress())
used = resource.getrusage(resource.RUSAGE_SELF)
print(used.ru_utime + used.ru_stime, used.ru_maxrss)
"""
"""A capture in a process of its own: trial, folder of the results. It prints processor time [s] and memory [kB]."""


@dataclass(frozen=True, kw_only=True)
class LongCapture:
    """What a capture took."""

    wall: float
    """Time from start to end [s]."""
    work: float
    """Processor time of all cores [s]."""
    memory: float
    """Largest memory of the process [GB]."""
    measured: float
    """Share of the frames with a pose."""


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
    before: tuple[int, LongCapture] | None = None
    for count in run.arguments.frames:
        found = captured(lengthened(run.out / f"frames{count}", count), run.out / f"results{count}")
        exponent = None if before is None else np.log(found.work / before[1].work) / np.log(count / before[0])
        table.row(str(count), found.wall, found.work, count / found.wall, found.memory, found.measured, exponent)
        before = count, found
    run.report(f"Load of the machine at the end, mean of a minute: {os.getloadavg()[0]:.1f}.")


def lengthened(folder: Path, count: int) -> Path:
    """Write the example at half size with a number of frames, the frames forwards and backwards in turn."""
    copy_half_trial(folder)
    for path in sorted(folder.glob("*.mp4")):
        film = cv2.VideoCapture(str(path))
        rate, images = film.get(cv2.CAP_PROP_FPS), []
        while (read := film.read())[0]:
            images.append(read[1])
        film.release()
        shown = images[EMPTY:]
        turn = [*shown, *shown[-2:0:-1]]
        height, width = shown[0].shape[:2]
        with VideoWriter(path, (width, height), rate=rate) as writer:
            for k in range(count):
                writer.add(turn[k % len(turn)])
    return folder


def captured(trial: Path, out: Path) -> LongCapture:
    """Capture a trial in a process of its own."""
    begin = time.perf_counter()
    command = [sys.executable, "-c", CAPTURE, str(trial), str(out)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    wall = time.perf_counter() - begin
    work, kilobytes = map(float, done.stdout.split())
    with np.load(out / "motion.npz") as motion:
        measured = float(np.mean(motion["state"] == 1))
    return LongCapture(wall=wall, work=work, memory=1024 * kilobytes / 1e9, measured=measured)
