"""Mend and refine a take with one choice of the recipe at a time, and score each, for docs/accuracy.md.

    python bench/choices.py SHARED OUT TAKE [TAKE ...] [--only NAME,NAME]

SHARED holds `data/people` and `score`. A take is captured once; only its mending and refinement are done for each of
CHOICES, from the same silhouettes and the same followed poses. Results lie in OUT/TAKE/CHOICE.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

from marey.fit.recipes.sequence import SequenceSettings
from marey.io.trial.trial import read_trial
from marey.pipelines.capture import capture
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.progress import RecordingProgress
from marey.process import tuned_process
from takes import empty_frames, score, truth_of

CHOICES: dict[str, dict[str, object]] = {
    "as it is": {},
    "no edges inside": {"interior": False},
    "no votes": {"vote": False},
    "rays": {"residual": "ray"},
}
KEPT = ("joint_mm", "joint_p95_mm", "steady_mm", "elbow_knee_deg", "elbow_knee_steady_deg", "covered_95")


def refined_by_choice(names: list[str], seconds: dict[str, float]):
    """Give stand-ins for the last two steps of a capture: refine and write once for each choice."""
    refine, write = capture._refined, capture.write_capture

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


@tuned_process()
def main() -> None:
    """Capture and score what was asked for; print one JSON line a choice."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("takes", nargs="+")
    parser.add_argument("--only", default=",".join(CHOICES))
    asked = parser.parse_args()
    names, seconds = asked.only.split(","), {}
    capture._refined, capture.write_capture = refined_by_choice(names, seconds)
    for take in asked.takes:
        trial, out = asked.shared / "data" / "people" / take, asked.out / take
        capture.capture_trial(read_trial(trial), CaptureSettings(out=out, overlay=False), RecordingProgress())
        for name in names:
            where = out / name.replace(" ", "_")
            skip = ("--skip-empty", empty_frames(trial))
            numbers = score(asked.shared / "score" / "capture.py", where, truth_of(trial), *skip)
            row = {key: numbers[key] for key in KEPT if key in numbers}
            print(json.dumps({"take": take, "choice": name, **row, "cpu_s": round(seconds[name], 1)}), flush=True)


if __name__ == "__main__":
    main()
