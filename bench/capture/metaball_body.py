"""Takes captured with metaballs of generic size, with fitted ones and with the learned body.

`--simple` adds the simplified limbs of the paper; `--body FILE` a `body.npz` of the same person, as `marey shape`
writes it, once unchanged and once refined; what follows `--options` goes to `marey capture`.
"""

import argparse
from pathlib import Path

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
    ),
    minutes=15,
)

BODIES = {
    "metaballs, generic sizes": ("--body", "metaballs", "--fixed-sizes"),
    "metaballs, fitted": ("--body", "metaballs"),
    "learned body": (),
}
SIMPLE = {
    "simple metaballs, generic sizes": ("--body", "simple-metaballs", "--fixed-sizes"),
    "simple metaballs, fitted": ("--body", "simple-metaballs"),
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help="of data/people; walk, balancing, stealth and reach without any")
    parser.add_argument("--simple", action="store_true", help="add the simplified limbs")
    parser.add_argument("--body", type=Path, help="a body.npz of the same person")
    parser.add_argument("--options", nargs=argparse.REMAINDER, default=[], help="more options for `marey capture`")


def run(run: Run) -> None:
    """Capture and score each take with each body."""
    given = run.arguments
    bodies = BODIES | (SIMPLE if given.simple else {})
    if given.body:
        body = ("--body", str(given.body))
        bodies |= {f"{given.body.parent.name}, unchanged": (*body, "--fixed-sizes")}
        bodies |= {f"{given.body.parent.name}, refined": body}
    table = begin(run, "Bodies", ("take", "body"), WHOLE)
    for name in given.takes or ("walk", "balancing", "stealth", "reach"):
        trial = run.shared / "data" / "people" / name
        for body_name, options in bodies.items():
            folder = "_".join([name, *options, *given.options]).replace("/", "-").replace("--", "") if options else name
            out = capture(trial, run.out / "takes" / folder, *options, *given.options)
            fill(table, (name, body_name), judged(run, trial, out), WHOLE)
