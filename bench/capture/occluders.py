"""Captures with furniture in front of the person in one to three cameras, against the truth.

A counter, two boxes, a rail, and a table with a counter are drawn into rendered takes and their images of the empty
room (`bench/capture/furniture.py`). `walk`, `reach` and `jacks` served to choose
constants, `stealth` is held out. With `--bare` the images of the empty room are left out, and nothing else is given.
"""

import argparse
from pathlib import Path

import numpy as np

from bench.capture.furniture import Cuboid, counter, furnished, rail, table, true_masks
from bench.capture.rooms import with_person, without_plate
from bench.common.program import capture, empty_frames, score
from bench.declaration import Bench
from bench.recording import Column, Run

BENCH = Bench(
    measures="Joints, intervals and visible silhouettes with furniture in front of the person, against rendered truth.",
    sources=(
        "src/marey/cameras",
        "src/marey/images",
        "src/marey/body",
        "src/marey/observations",
        "src/marey/fit",
        "src/marey/motion",
        "src/marey/pipelines/capture",
        "src/marey/pipelines/silhouettes",
        "src/marey/pipelines/consistency",
        "src/marey/pipelines/occlusion",
    ),
    minutes=12,
)
THINGS: dict[str, list[Cuboid]] = {
    "walk": counter((0.8, 1.3), (-1.2, 1.2), 1.05),
    "reach": counter((0.7, 1.1), (-1.1, -0.5), 0.9) + counter((0.55, 1.0), (0.75, 1.2), 1.0),
    "jacks": rail((0.8, -1.0), (0.8, 1.0), (0.55, 1.0)),
    "stealth": table((0.65, 1.25), (-1.0, 0.4), 0.95) + counter((-1.3, -0.9), (-0.2, 0.9), 0.9),
}
"""The furniture of each take."""
COLUMNS = (
    (Column("joints", "mm", 1), "joint_mm"),
    (Column("worst joint, 95 %", "mm", 0), "joint_p95_mm"),
    (Column("own steady", "mm", 1), "own_steady_mm"),
    (Column("silhouettes IoU", "", 3), "iou"),
    (Column("95 % intervals hold", "", 3), "own_covered_95"),
    (Column("hidden", "%", 1), "hidden"),
    (Column("agreement by camera"), "agreement"),
)
"""Columns of the table, with the names of the figures."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help=f"of {', '.join(THINGS)}; all without one")
    parser.add_argument("--bare", action="store_true", help="leave out the images of the empty room")


def judged(run: Run, trial: Path, out: Path) -> dict:
    """Score motion and visible silhouettes, and state the hidden part of the person in the camera that sees least."""
    skip = ("--skip-empty", empty_frames(trial))
    numbers = score(run, "capture.py", out, trial / "truth" / "truth.npz", *skip)
    numbers |= score(run, "masks.py", out, trial / "truth" / "masks.npz", *skip)
    hidden, seen = (true_masks(trial, name).sum((1, 2, 3)) for name in ("hidden", "masks"))
    agreement = np.nanmean(np.load(out / "motion.npz")["agreement"], 0)
    return numbers | {
        "hidden": 100 * float(np.max(hidden / (hidden + seen))),
        "agreement": " ".join(f"{value:.2f}" for value in agreement),
    }


def run(run: Run) -> None:
    """Make, capture and score the takes."""
    given = run.arguments
    title = "Furniture before the person" + (", nothing given" if given.bare else "")
    note = (
        "*Hidden*: what the furniture truly hides of the person in the camera in which it hides most. *Silhouettes*: "
        "against what is visible of the person."
    )
    rows = run.table(title, "take", *(column for column, _ in COLUMNS), note=note)
    for name in given.takes or THINGS:
        place = run.out / "occluders" / name
        trial, more = furnished(run.shared / "data" / "people" / name, place / "trial", THINGS[name]), {}
        opened = trial
        if given.bare:
            opened, more = without_plate(trial, place / "bare"), with_person(trial)
        out = capture(opened, place / ("bare_results" if given.bare else "results"), **more)
        numbers = judged(run, trial, out)
        rows.row(name, *(numbers[key] for _, key in COLUMNS))
