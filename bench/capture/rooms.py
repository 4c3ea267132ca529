"""Captures without images of the empty room against their truth.

Detected key points take the place of the images of the empty room; a second table has the same takes with nothing but
the videos and the calibration. The takes `market` and `office` have none; of
`jacks` the images and the leading empty frames, and of `balancing` the images are left out, for which the files of the
trial are linked into a folder without them. `jacks`, `market` and `office` are rendered, with exact truth; `balancing`
is real, and its reference are key points that another detector found, with errors of some centimetres. With nothing
given, `walk`, `reach` and `stealth` follow in the same way: no constant of captures without images of the empty room
was chosen from `walk` and `stealth`, and `reach` showed that the sizes of the body grew too large.
A third table has the takes with their leading frames in which nobody is present.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from bench.common.program import capture, empty_frames, score, truth_of
from bench.declaration import Bench
from bench.recording import Column, Run

BENCH = Bench(
    measures=(
        "Joints, silhouettes and intervals of takes without images of the empty room, with detected key points and "
        "with nothing, against rendered truth or key points."
    ),
    sources=(
        "src/marey/cameras",
        "src/marey/images",
        "src/marey/body",
        "src/marey/observations",
        "src/marey/fit",
        "src/marey/motion",
        "src/marey/io/trial",
        "src/marey/pipelines/capture",
        "src/marey/pipelines/silhouettes",
    ),
    minutes=45,
)

TAKES = ("jacks", "market", "office", "balancing")
HELD_OUT = ("walk", "reach", "stealth")
"""Takes with nothing given beside those above."""
TAKES_OF = {"detected": TAKES, "nothing": (*TAKES, *HELD_OUT), "empty": ("jacks", *HELD_OUT)}
"""Takes of each table."""
COLUMNS = (
    (Column("joints", "mm", 1), "joint_mm"),
    (Column("worst joint, 95 %", "mm", 0), "joint_p95_mm"),
    (Column("own steady", "mm", 1), "own_steady_mm"),
    (Column("silhouettes IoU", "", 3), "iou_masks"),
    (Column("95 % intervals hold", "", 2), "own_covered_95"),
    (Column("frames with a result", "", 3), "seen"),
    (Column("time", "s", 0), "seconds"),
)
"""Columns of the table, with the names of the figures."""
NOTE = (
    "*Joints*: mean distance of the twelve limb joint centres from the truth; *own steady*: the same without each "
    "joint's constant offset in the frame of its limb, which the intervals leave out, too. *Silhouettes*: against what "
    "is visible of the person. *Time*: all stages together."
)


def without_plate(trial: Path, folder: Path) -> Path:
    """Link the files of a trial into a folder, but for its images of the empty room and its truth."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in trial.iterdir():
        link = folder / path.name
        if path.name not in ("background", "truth") and not link.exists():
            link.symlink_to(path.resolve())
    return folder


def with_person(trial: Path) -> dict[str, range]:
    """Return the setting that selects the frames after the leading empty ones, if there are any."""
    empty = empty_frames(trial)
    return {"frames": range(empty, empty + len(np.load(truth_of(trial))["joints"]))} if empty else {}


def judged(run: Run, trial: Path, out: Path) -> dict:
    """Score motion and silhouettes of a take."""
    skip = ("--skip-empty", empty_frames(trial))
    numbers = score(run, "capture.py", out, truth_of(trial), *skip)
    if truth_of(trial).name != "truth.npz":  # Key points have errors of their own, which the intervals do not include.
        numbers.pop("own_covered_95", None)
    masks = trial / "truth" / "masks.npz"
    masks = masks if masks.exists() else trial / "truth" / "masks"
    numbers["iou_masks"] = score(run, "masks.py", out, masks, *skip)["iou"]
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    return numbers | {"seconds": float(np.sum(list(record["timings_s"].values())))}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help=f"of {', '.join(TAKES)}, or another folder of data/people")


def run(run: Run) -> None:
    """Capture and score."""
    columns = [column for column, _ in COLUMNS]
    titles = {
        "detected": "With detected key points, without images of the empty room",
        "nothing": "With nothing but the videos and the calibration",
        "empty": "With nothing but the videos, which begin with frames that show nobody, and the calibration",
    }
    for given, title in titles.items():
        table = run.table(title, "take", *columns, note=NOTE)
        for name in run.arguments.takes or TAKES_OF[given]:
            trial = run.shared / "data" / "people" / name
            if given == "empty" and not empty_frames(trial):
                continue
            bare = without_plate(trial, run.out / "rooms" / "trials" / name)
            more = {} if given == "empty" else with_person(trial)
            more |= {"keypoints": bare / "keypoints"} if given == "detected" else {}
            numbers = judged(run, trial, capture(bare, run.out / "rooms" / given / name, **more))
            table.row(name, *(numbers.get(key) for _, key in COLUMNS))
