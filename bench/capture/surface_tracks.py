"""Turns of limbs about their own axes, with and without tracks of the surface.

The takes `reach`, `stealth`, `jacks` and `walk` are captured with images of the empty room; `market`, which has none,
and `jacks` without them are captured with detected key points. All are rendered, with exact truth.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from bench.capture.rooms import with_person, without_plate
from bench.common.program import capture, empty_frames, score, truth_of
from bench.declaration import Bench
from bench.recording import Column, Run

BENCH = Bench(
    measures="Turns of limbs about their axes, joints and intervals, with and without tracks of the surface.",
    sources=(
        "src/marey/cameras",
        "src/marey/images",
        "src/marey/body",
        "src/marey/observations",
        "src/marey/fit",
        "src/marey/motion",
        "src/marey/pipelines/capture",
        "src/marey/pipelines/silhouettes",
    ),
    minutes=12,
)

TAKES = ("reach", "stealth", "jacks", "walk", "market", "jacks (key points)")
LIMBS = {"thorax": "thorax", "head": "head", "upper arms": "upperarm", "forearms": "forearm", "thighs": "thigh"}
COLUMNS = (
    Column("all limbs", "deg", 1),
    *(Column(name, "deg", 1) for name in LIMBS),
    Column("joints", "mm", 1),
    Column("worst joint, 95 %", "mm", 0),
    Column("own steady", "mm", 1),
    Column("95 % intervals hold", "", 2),
    Column("time", "s", 0),
)
FIGURES = ("joint_mm", "joint_p95_mm", "own_steady_mm", "own_covered_95")
NOTE = (
    "*Limbs*: rotation of the segment since its first frame, against the truth, root mean square over limbs and "
    "frames; errors of the first frame count in all others. *Own steady*: mean distance of the limb joint centres "
    "from the truth without each joint's constant offset in the frame of its limb, which the intervals leave out, "
    "too. *Time*: all stages together."
)


def judged(run: Run, trial: Path, out: Path) -> list[float]:
    """Return the figures of a take in the order of the columns."""
    skip = ("--skip-empty", empty_frames(trial))
    numbers = score(run, "capture.py", out, truth_of(trial), *skip)
    scored = (score(run, "capture.py", out, truth_of(trial), *skip, "--limbs", limb) for limb in LIMBS.values())
    turns = [limb["turn_deg"] for limb in scored]
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    seconds = float(np.sum(list(record["timings_s"].values())))
    return [numbers["turn_deg"], *turns, *(numbers[name] for name in FIGURES), seconds]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help=f"of {', '.join(TAKES)}")


def run(run: Run) -> None:
    """Capture with and without tracks, and score."""
    table = run.table("Turns of limbs", ("take", "tracks"), *COLUMNS, note=NOTE)
    for name in run.arguments.takes or TAKES:
        trial, settings = run.shared / "data" / "people" / name.split()[0], {}
        source = trial
        if name.endswith("(key points)") or not (trial / "background").exists():
            source = without_plate(trial, run.out / "surface_tracks" / "trials" / trial.name)
            settings = {"keypoints": source / "keypoints", **with_person(trial)}
        for tracks in (False, True):
            folder = run.out / "surface_tracks" / f"{name.replace(' ', '_')}_{tracks}"
            out = capture(source, folder, surface_tracks=tracks, **settings)
            table.row((name, "yes" if tracks else "no"), *judged(run, trial, out))
