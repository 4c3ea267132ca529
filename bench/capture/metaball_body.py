"""Takes captured with metaballs of generic size, with fitted ones and with the learned body.

`--simple` adds the simplified limbs of the paper; `--body FILE` a `body.npz` of the same person, as `marey shape`
writes it, once unchanged and once refined.
"""

import argparse
from pathlib import Path
from typing import Any

from bench.capture.takes import WHOLE, begin, fill, judged
from bench.common.program import capture
from bench.declaration import Bench
from bench.recording import Run

BENCH = Bench(
    measures=(
        "Captures with generic metaballs, fitted metaballs and the learned body, against rendered truth or key points."
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
    minutes=15,
)

Settings = dict[str, Any]
"""Arguments of `marey.capture`."""
BODIES: dict[str, Settings] = {
    "metaballs, generic sizes": {"body": "metaballs", "fixed_sizes": True},
    "metaballs, fitted": {"body": "metaballs"},
    "learned body": {},
}
SIMPLE: dict[str, Settings] = {
    "simple metaballs, generic sizes": {"body": "simple-metaballs", "fixed_sizes": True},
    "simple metaballs, fitted": {"body": "simple-metaballs"},
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help="of data/people; walk, balancing, stealth and reach without any")
    parser.add_argument("--simple", action="store_true", help="add the simplified limbs")
    parser.add_argument("--body", type=Path, help="a body.npz of the same person")


def run(run: Run) -> None:
    """Capture and score each take with each body."""
    given = run.arguments
    bodies = BODIES | (SIMPLE if given.simple else {})
    if given.body:
        bodies |= {f"{given.body.parent.name}, unchanged": {"body": given.body, "fixed_sizes": True}}
        bodies |= {f"{given.body.parent.name}, refined": {"body": given.body}}
    table = begin(run, "Bodies", ("take", "body"), WHOLE)
    for name in given.takes or ("walk", "balancing", "stealth", "reach"):
        trial = run.shared / "data" / "people" / name
        for body_name, settings in bodies.items():
            folder = f"{name}_{body_name.replace(', ', '_').replace(' ', '_')}" if settings else name
            out = capture(trial, run.out / "takes" / folder, **settings)
            fill(table, (name, body_name), judged(run, trial, out), WHOLE)
