"""Capture takes with metaballs of generic size, with fitted ones and with the learned body, for docs/accuracy.md.

    python bench/metaball_body.py SHARED OUT [walk balancing ...] [--simple] [--body FILE] [--options ...]

SHARED holds `data/people` and `score`. --simple adds the paper's simplified limbs; --body FILE a body.npz of the same
person, as `marey shape` leaves it, once as it is and once refined; what follows --options goes to `marey capture`.
Results lie in OUT/TAKE_BODY; a finished one is not made again.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from takes import capture, judged

BODIES = {
    "metaballs, generic sizes": ("--body", "metaballs", "--fixed-sizes"),
    "metaballs, fitted": ("--body", "metaballs"),
    "learned body": (),
}
SIMPLE = {
    "simple metaballs, generic sizes": ("--body", "simple-metaballs", "--fixed-sizes"),
    "simple metaballs, fitted": ("--body", "simple-metaballs"),
}
KEPT = ("joint_mm", "joint_p95_mm", "steady_mm", "elbow_knee_deg", "elbow_knee_steady_deg", "covered_95")
KEPT += ("iou_masks", "iou_surface_masks", "lengths_worst_mm", "lengths_in_sd")


def main() -> None:
    """Capture and score what was asked for; print one JSON line a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("takes", nargs="*", default=["walk", "balancing"])
    parser.add_argument("--simple", action="store_true")
    parser.add_argument("--body", type=Path)
    parser.add_argument("--options", nargs=argparse.REMAINDER, default=[])
    asked = parser.parse_args()
    bodies = BODIES | (SIMPLE if asked.simple else {})
    if asked.body:
        given = ("--body", str(asked.body))
        bodies |= {f"{asked.body.parent.name}, as it is": (*given, "--fixed-sizes")}
        bodies |= {f"{asked.body.parent.name}, refined": given}
    for take in asked.takes or ["walk", "balancing"]:
        trial = asked.shared / "data" / "people" / take
        for name, options in bodies.items():
            out = asked.out / f"{take}_{name.replace(', ', '_').replace(' ', '_')}"
            capture(trial, out, *options, *asked.options)
            numbers = judged(asked.shared, trial, out)
            row = {key: numbers[key] for key in KEPT if np.isfinite(numbers.get(key, np.nan))}
            agreement = float(np.mean(numbers["agreement"]))
            print(json.dumps({"take": take, "body": name, **row, "agreement": round(agreement, 3)}), flush=True)


if __name__ == "__main__":
    main()
