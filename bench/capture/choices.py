"""Takes refined with one choice of the method at a time.

A take is captured once; only its completion and refinement are repeated for each of `CHOICES`, from the same
silhouettes and the same tracked poses.
"""

import argparse
import time
from dataclasses import replace

from bench.capture.takes import MOTION, begin, fill
from bench.common.program import empty_frames, score, truth_of
from bench.declaration import Bench
from bench.recording import Run
from marey.fit.recipes.sequence import SequenceSettings
from marey.io.trial.trial import read_trial
from marey.pipelines.capture import capture
from marey.pipelines.capture.run import opened
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.progress import RecordingProgress
from marey.process import tuned_process

BENCH = Bench(
    measures=(
        "Captured motion with one choice of the refinement changed at a time, against rendered truth or key points."
    ),
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
    minutes=20,
)

CHOICES: dict[str, dict[str, object]] = {
    "unchanged": {},
    "no edges inside": {"interior": False},
    "no votes": {"vote": False},
    "rays": {"residual": "ray"},
}


def refined_by_choice(names: list[str], seconds: dict[str, float]):
    """Return stand-ins for the last two steps of a capture: refine and write once for each choice."""
    refine, write = capture.refined_person, capture.write_capture

    def refined(run, *found):
        fits = {}
        for name in names:
            person = replace(run.person, sequence=SequenceSettings(**CHOICES[name]))
            began = time.process_time()
            fits[name] = refine(replace(run, person=person, scope=(run.scope, name)), *found)
            seconds[name] = time.process_time() - began
        return fits

    def write_each(run, fits, store, frames):
        for name, fit in fits.items():
            write(replace(run, out=run.out / name.replace(" ", "_")), fit, store, frames)

    return refined, write_each


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help="of data/people; reach, walk, stealth and jacks without any")
    parser.add_argument("--only", default=",".join(CHOICES), metavar="NAME,NAME", help=", ".join(CHOICES))


def run(run: Run) -> None:
    """Capture, refine by choice, and score."""
    names, seconds = run.arguments.only.split(","), dict[str, float]()
    capture.refined_person, capture.write_capture = refined_by_choice(names, seconds)
    table = begin(run, "One choice changed at a time", ("take", "choice"), MOTION)
    for take in run.arguments.takes or ("reach", "walk", "stealth", "jacks"):
        trial, out = run.shared / "data" / "people" / take, run.out / "choices" / take
        settings = CaptureSettings(out=out, overlay=False)
        with tuned_process(), opened(read_trial(trial), settings, RecordingProgress()) as (run_on_trial, bodies, logs):
            capture.run_capture(run_on_trial, bodies, logs)
        for name in names:
            skip = ("--skip-empty", empty_frames(trial))
            numbers = score(run, "capture.py", out / name.replace(" ", "_"), truth_of(trial), *skip)
            fill(table, (take, name), numbers, MOTION)
    spent = "; ".join(f"{name} {seconds[name]:.0f} s" for name in names)
    table.note += f" Processor time of the last take's refinement: {spent}."
