"""Captures of everybody in takes of two people, against the truth of both.

The second person is the first one some frames later, drawn into every image in front of or behind the first
(`bench/common/sabotaged_takes.py`). The two look the same, do not touch, and hide each other in some images. They are
captured with images of the empty room, and with nothing but the videos and the calibration.
"""

from pathlib import Path

import numpy as np

import marey
from bench.capture.rooms import without_plate
from bench.common.program import empty_frames, score, truth_of
from bench.common.sabotaged_takes import TakeCopy, later, two_people
from bench.declaration import Bench
from bench.recording import Column, Run

BENCH = Bench(
    measures="Joints and intervals of two people in one take, with `--people all`, against rendered truth.",
    sources=(
        "src/marey/fit",
        "src/marey/images",
        "src/marey/pipelines/capture",
        "src/marey/pipelines/group",
        "src/marey/pipelines/people",
        "src/marey/pipelines/silhouettes",
    ),
    minutes=12,
)
TAKES = {"walk": (40, range(0, 59)), "stealth": (85, range(8, 35))}
"""The number of frames by which the second person is ahead, and the frames in which the two do not touch, counted from
the first frame that shows a person. They are at least 0.5 m apart in `walk`, and from 0.2 to 0.6 m in `stealth`."""
COLUMNS = (
    (Column("joints", "mm", 1), "joint_mm"),
    (Column("worst joint, 95 %", "mm", 0), "joint_p95_mm"),
    (Column("own steady", "mm", 1), "own_steady_mm"),
    (Column("95 % intervals hold", "", 2), "own_covered_95"),
    (Column("frames with a result", "", 3), "seen"),
)
"""Columns of the table, with the names of the figures."""


def run(run: Run) -> None:
    """Make, capture and score the takes."""
    for given in ("images of the empty room", "nothing"):
        table = run.table(f"Two people, {given} given", ("take", "person"), *(column for column, _ in COLUMNS))
        for name in TAKES:
            for person, numbers in judged(run, name, bare=given == "nothing").items():
                table.row((name, person), *(numbers.get(key) for _, key in COLUMNS))


def judged(run: Run, name: str, *, bare: bool) -> dict[str, dict]:
    """Capture everybody in a take with a second person; the figures of the captured person nearest to each true one.

    Args:
        run: The run.
        name: The name of the take.
        bare: Whether the images of the empty room are left out.
    """
    take, place = run.shared / "data" / "people" / name, run.out / "everybody" / name
    ahead, frames = TAKES[name]
    empty = empty_frames(take)
    trial, truth = place / "trial", truth_of(take)
    if not trial.exists():
        two_people(ahead)(TakeCopy.of(take, trial))
    opened = without_plate(trial, place / "bare") if bare else trial
    out = place / ("nothing" if bare else "plates")
    if not (out / "people.csv").exists():
        chosen = marey.open_trial(opened, frames=range(frames.start + empty, frames.stop + empty))
        with marey.tuned_process():
            marey.capture_people(chosen, out=out, overlay=False, progress=marey.RecordingProgress())
    references = {"behind": truth, "ahead": later(truth, ahead, place / "later.npz")}
    return {person: nearest(run, out, reference, empty, len(frames)) for person, reference in references.items()}


def nearest(run: Run, out: Path, reference: Path, empty: int, count: int) -> dict:
    """Return the figures of the captured person who is nearest to a true one.

    Args:
        run: The run.
        out: The folder with the results of everybody.
        reference: The truth of one person.
        empty: Number of leading frames without a person.
        count: Number of frames that were captured, of which the share with a result is stated.
    """
    folders = sorted(path.parent for path in out.glob("person*/motion.npz"))
    found = [score(run, "capture.py", folder, reference, "--skip-empty", empty) for folder in folders]
    best = min(found, key=lambda numbers: numbers["joint_mm"])
    return best | {"seen": best["seen"] * len(np.load(reference)["joints"]) / count}
