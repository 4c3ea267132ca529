"""Clocks of cameras: of rendered free-running ones, and of delays that are planted in synchronous takes.

A delay is planted by leaving the first pictures of a camera away; one below a frame by keeping every second or third
picture, with another one first. The signals of a take are measured once, and their samples are selected as its pictures
would be. An error is that of the instant which the estimated clock gives for a picture in the middle, or at the worse
end, of the camera's video. `--captures` also captures `clocks` and `walk`, which takes four minutes more.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.common.program import capture, empty_frames, score
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.fit.clocks.estimate import estimate_clocks
from marey.fit.clocks.signals import EpipolarSignal
from marey.io.trial.trial import read_free_trial
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.sync.measurements import key_point_signals, silhouette_signals
from marey.pipelines.sync.tasks import synchronise

BENCH = Bench(
    measures="Offsets and drifts of cameras' clocks against exact truth, and joints captured with them.",
    sources=("src/marey/fit/clocks", "src/marey/pipelines/sync", "src/marey/cameras/epipolar.py"),
    minutes=2,
)
TAKES = ("walk", "reach", "jacks", "stealth")
RATE = 30.0
PLANS = (
    (1, (0, 1, 3, 10)), (1, (10, 3, 1, 0)), (1, (0, 0, 15, 0)), (2, (0, 1, 0, 1)), (2, (0, 0, 3, 1)), (3, (0, 1, 2, 0)),
    (3, (0, 2, 1, 1)),
)  # fmt: skip
"""Every how many pictures one is kept, and the first picture of each of four cameras."""


def selected(signal: EpipolarSignal, pictures: Sequence[np.ndarray]) -> EpipolarSignal:
    """Return the signal that a selection of each camera's pictures would give."""
    kept = [pictures[c] for c in signal.cameras]
    first, second = (angles[own] for angles, own in zip(signal.angles, kept, strict=True))
    scale, other = (scales[own] for scales, own in zip(signal.radians_per_pixel, kept, strict=True))
    return replace(signal, angles=(first, second), radians_per_pixel=(scale, other))


def planted(signals: Sequence[EpipolarSignal], count: int, step: int, first: Sequence[int]) -> list[tuple]:
    """Estimate the clocks with planted delays; errors in frames and in standard deviations, one row per camera."""
    pictures, rate = [np.arange(begin, count, step) for begin in first], RATE / step
    names = [f"cam{c + 1:02d}" for c in range(len(first))]
    times = [np.arange(len(own)) / rate for own in pictures]
    clocks = estimate_clocks(names, times, [selected(signal, pictures) for signal in signals]).clocks
    rows: list[tuple] = []
    for c, name in enumerate(names[1:], 1):
        if name not in clocks.names:
            rows.append((None, None, None, None))
            continue
        k = clocks.names.index(name)
        start, end = ((clocks.instants(k, t) - t - (first[c] - first[0]) / RATE) * rate for t in (0.0, times[c][-1]))
        deviations = start / rate / clocks.offset_sd_s[k], clocks.drift[k] / clocks.drift_sd[k]
        rows.append((abs(start + end) / 2, max(abs(start), abs(end)), *deviations))
    return rows


def tables_of_delays(run: Run, source: str) -> None:
    """Measure the delays that are planted in each take."""
    columns = (
        Column("clocks determined"), Column("middle, root mean square", "frames", 3),
        Column("middle, worst", "frames", 3), Column("end, worst", "frames", 3),
        Column("held by 95 % intervals", "%", 0),
    )  # fmt: skip
    table = run.table(f"Planted delays, {source}", ("take", "pictures kept"), *columns)
    for name in TAKES:
        folder = run.shared / "data" / "people" / name
        keypoints = {"folder": str(folder / "keypoints")}
        trial = read_free_trial(folder, keypoints=keypoints if source == "key points" else None)
        measure = key_point_signals if source == "key points" else silhouette_signals
        signals = measure(trial, RecordingProgress())
        for step in sorted({step for step, _ in PLANS}):
            rows = [row for s, first in PLANS if s == step for row in planted(signals, trial.take.count, step, first)]
            known = np.array([row for row in rows if row[0] is not None], float)
            middle, end, held = known[:, 0], known[:, 1], np.abs(known[:, 2:]) < 1.96
            table.row(
                (name, f"1 of {step}"), f"{len(known)} of {len(rows)}", np.sqrt(np.mean(middle**2)), middle.max(),
                end.max(), 100 * held.mean(),
            )  # fmt: skip


def table_of_clocks(run: Run) -> None:
    """Measure the rendered free-running cameras by the agreed script."""
    folder = run.shared / "data" / "people" / "clocks"
    path, progress = run.out / "clocks.json", RecordingProgress()
    synchronise(folder, out=path, progress=progress)
    found = score(run, "sync.py", path, folder / "truth" / "truth.npz")
    table = run.table(
        "Free-running cameras (`clocks`)", "take", Column("middle, worst", "frames", 3),
        Column("end, worst", "frames", 3), Column("drift, worst", "ppm", 0),
        Column("held by 95 % intervals", "%", 0), Column("time", "s", 0),
    )  # fmt: skip
    table.row(
        "clocks", found["worst_frames"], found["worst_end_frames"], found["worst_drift_ppm"], 100 * found["held_95"],
        sum(progress.timings.values()),
    )  # fmt: skip


def table_of_captures(run: Run) -> None:
    """Capture the free-running cameras, which the capture notices itself, and the same person filmed together."""
    columns = (Column("joints", "mm", 1), Column("steady", "mm", 1), Column("answered", "%", 0), Column("held", "%", 0))
    table = run.table("Captures (`clocks` without sync.json)", "take", *columns)
    for name in ("walk", "clocks"):
        folder = run.shared / "data" / "people" / name
        out = capture(folder, run.out / "takes" / name)
        skipped = ("--skip-empty", empty_frames(folder))
        found = score(run, "capture.py", out, folder / "truth" / "truth.npz", *skipped)
        shares = 100 * found["seen"], 100 * found["covered_95"]
        table.row(name, found["joint_mm"], found["steady_mm"], *shares)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--captures", action="store_true", help="capture clocks and walk, too")


def run(run: Run) -> None:
    """Measure clocks, delays, and captures."""
    table_of_clocks(run)
    tables_of_delays(run, "silhouettes")
    tables_of_delays(run, "key points")
    if run.arguments.captures:
        table_of_captures(run)
