"""The speeds of `marey bench`: ours and the peers', measured in the same run.

The pose solve is compared with scipy.optimize.least_squares, and the level set with scikit-image's where that is
installed. With `--take` the whole path from video to results is timed too.
"""

import argparse

from bench.declaration import Bench
from bench.provenance import PROJECT
from bench.recording import Column, Run
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.speed.speeds import measure_speeds
from marey.process import tuned_process

BENCH = Bench(
    measures="Times of `marey bench`: pose solve, drawing, silhouettes, surface, live wire, and the whole capture.",
    sources=(
        "src/marey/fit",
        "src/marey/images",
        "src/marey/surface",
        "src/marey/observations",
        "src/marey/pipelines/speed",
    ),
    minutes=3,
    data=False,
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--take", help="a take of data/people to capture whole")


def run(run: Run) -> None:
    """Time."""
    trial = run.shared / "data" / "people" / run.arguments.take if run.arguments.take else None
    table = run.table("Speeds", "what", Column("measured"), Column("beside"), Column("remark"))
    with tuned_process():
        speeds = measure_speeds(trial, example=PROJECT / "examples" / "reach", progress=RecordingProgress())
    for speed in speeds:
        table.row(speed.what, speed.measured, speed.beside, speed.remark)
