"""How time and memory grow with cameras, with the size of the images, with correspondences and with patches.

A made person walks on the spot in a made room (`bench/common/made_room.py`). Each capture is a process of its own,
whose memory is the largest that it occupied. Its time is that of all stages from the videos to the final poses,
without the start, which is independent of the number of frames. The exponent is that of the processor time against the
quantity, from one row to the next: 1 for what grows in proportion, less where a part of the work stays the same. For
images it counts pixels.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from bench.common.made_room import LIMB_JOINTS, limb_joints, made_person, ring, walk_on_the_spot, write_room
from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run
from bench.surface.matching import SIZE, pictures
from marey.images.matching.matching import MatchSettings, match
from marey.images.matching.splines import spline_of
from marey.pipelines.speed.speeds import median_ms, solve_task

BENCH = Bench(
    measures="Growth of time and memory with cameras, pixels, correspondences and patches.",
    sources=(
        "src/marey/cameras", "src/marey/fit", "src/marey/images", "src/marey/io/video", "src/marey/observations",
        "src/marey/pipelines/capture", "src/marey/pipelines/silhouettes", "src/marey/process.py",
    ),
    minutes=15,
    data=False,
)  # fmt: skip
CAPTURE = """
import json, resource, sys, time, marey
class Progress(marey.RecordingProgress):
    def stage(self, name, total=None, *, done=0):
        marks.append((name, time.process_time()))
        return super().stage(name, total, done=done)
marks = []
with marey.tuned_process():
    marey.capture(sys.argv[1], out=sys.argv[2], overlay=False, progress=Progress())
marks.append(("", time.process_time()))
work = {}
for (name, begin), (_, end) in zip(marks, marks[1:]):
    work[name] = work.get(name, 0.0) + end - begin
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps({"work": work, "memory": 1024 * used.ru_maxrss / 1e9}))
"""
"""A capture in a process of its own: trial, folder of the results. It prints the processor time of each stage [s] and
the memory [GB]."""
LEFT_OUT = ("Start", "Comparison", "Results", "Report")
"""Stages that are no part of the way from the videos to the final poses, or do not depend on the number of frames."""
VGA = (640, 480)
CAMERAS = (2, 4, 8)
SIZES = (VGA, (1280, 960), (1920, 1440))
"""Sizes of images with an equal view; the last one has a third more pixels than Full HD."""
CORRESPONDENCES = (1250, 2500, 5000, 10000, 20000)
STEPS = (16, 8, 4)
"""Distances of the centres of patches [px]: each row has four times as many as the one before."""


@dataclass(frozen=True, kw_only=True)
class MadeCapture:
    """What a capture of a made take needed and found."""

    wall: float
    """Time of the stages that count [s]."""
    work: float
    """Processor time of these stages [s]."""
    memory: float
    """Largest memory of the process [GB]."""
    joints_mm: float
    """Mean error of the joint centres of the limbs [mm]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--frames", type=int, default=60, help="frames of the made takes")
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Fill the tables."""
    run_parts(run, PARTS)


def compile_kernels(run: Run) -> None:
    """Capture once, so that no measured capture compiles a kernel."""
    captured(run, 4, VGA, 20)


def of_cameras(run: Run) -> None:
    """Capture with several numbers of cameras."""
    frames = run.arguments.frames
    compile_kernels(run)
    found = {count: captured(run, count, VGA, frames) for count in CAMERAS}
    rows = {f"{count}": (count, each) for count, each in found.items()}
    _capture_table(run, f"Cameras of {VGA[0]} x {VGA[1]} px, {frames} frames", "cameras", rows, {c: c for c in found})


def of_pixels(run: Run) -> None:
    """Capture with several sizes of the images."""
    frames = run.arguments.frames
    compile_kernels(run)
    found = {size: captured(run, 4, size, frames) for size in SIZES}
    rows = {f"{size[0]} x {size[1]}": (size[0] * size[1], each) for size, each in found.items()}
    _capture_table(run, f"Images of four cameras, {frames} frames", "size [px]", rows, {n: 4 for n, _ in rows.values()})


def _capture_table(
    run: Run, title: str, label: str, rows: dict[str, tuple[int, MadeCapture]], cameras: dict[int, int]
) -> None:
    table = run.table(
        title, label, Column("time", "s", 1), Column("core time", "s", 1),
        Column("core time per frame and camera", "ms", 1), Column("against the first row", "", 2),
        Column("exponent", "", 2), Column("memory", "GB", 2), Column("joints", "mm", 1),
    )  # fmt: skip
    before: tuple[int, float] | None = None
    first: float | None = None
    for name, (amount, each) in rows.items():
        own = 1e3 * each.work / run.arguments.frames / cameras[amount]
        first = own if first is None else first
        exponent = None if before is None else np.log(each.work / before[1]) / np.log(amount / before[0])
        table.row(name, each.wall, each.work, own, own / first, exponent, each.memory, each.joints_mm)
        before = amount, each.work


def captured(run: Run, cameras: int, size: tuple[int, int], frames: int) -> MadeCapture:
    """Make a take and capture it in a process of its own."""
    name = f"{cameras}cameras_{size[0]}x{size[1]}_{frames}frames"
    truth = walk_on_the_spot(made_person(), frames)
    trial = run.out / f"{name}_trial"
    if not (trial / "cameras.toml").exists():
        write_room(trial, tuple(ring(cameras, size)), truth)
    out = run.out / f"{name}_results_{time.time_ns()}"
    command = [sys.executable, "-c", CAPTURE, str(trial), str(out)]
    printed = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
    timings = json.loads((out / "run.json").read_text())["timings_s"]
    return MadeCapture(
        wall=sum(seconds for stage, seconds in timings.items() if stage not in LEFT_OUT),
        work=sum(seconds for stage, seconds in printed["work"].items() if stage not in LEFT_OUT),
        memory=printed["memory"], joints_mm=_error_mm(out, [limb_joints(posed) for posed in truth]),
    )  # fmt: skip


def _error_mm(out: Path, truth: list[np.ndarray]) -> float:
    """Return the mean distance of the limbs' joint centres from the truth [mm]."""
    with np.load(out / "motion.npz") as motion:
        names = [str(name) for name in motion["joint_names"]]
        found = motion["joint_centres"][:, [names.index(name) for name in LIMB_JOINTS]]
    return 1e3 * float(np.nanmean(np.linalg.norm(found - np.array(truth), axis=-1)))


def of_points(run: Run) -> None:
    """Solve for a pose with several numbers of correspondences."""
    tasks = {count: solve_task(np.random.default_rng(0), count) for count in CORRESPONDENCES}
    _work_table(run, "Pose", "correspondences", {count: task.solve for count, task in tasks.items()})


def of_patches(run: Run) -> None:
    """Match several numbers of patches."""
    template, search, pixels, truth = pictures(np.random.default_rng(0), 1.0)
    splines, settings = (spline_of(template), spline_of(search)), MatchSettings(noise=1.0, size=SIZE)
    works: dict[int, Callable[[], object]] = {}
    for step in STEPS:
        own = ((pixels - pixels[0]) % step == 0).all(axis=1)
        works[int(own.sum())] = partial(match, *splines, pixels[own], truth[own], settings=settings, threads=1)
    _work_table(run, f"Patches of {SIZE} x {SIZE} px", "patches", works)


def _work_table(run: Run, title: str, label: str, works: dict[int, Callable[[], object]]) -> None:
    table = run.table(title, label, Column("core time", "ms", 2), Column("exponent", "", 2))
    before: tuple[int, float] | None = None
    for count, work in works.items():
        spent = median_ms(work, repeats=15)
        exponent = None if before is None else np.log(spent / before[1]) / np.log(count / before[0])
        table.row(str(count), spent, exponent)
        before = count, spent


PARTS = {"cameras": of_cameras, "pixels": of_pixels, "points": of_points, "patches": of_patches}
