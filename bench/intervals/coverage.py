"""Whether stated standard deviations describe the true errors, for every capability, over takes, persons and seeds.

Capabilities: bones (from skin markers), cameras (calibrated from boards and wands), clocks, one-camera, many-cameras
and perspective (non-rigid shapes), knee (balls, registered bones, cartilage), bodies (shapes of people),
clicked-bodies (their start from clicked joints), motion (capture, also with few cameras and from single frames),
surface (points and trajectories). Without any argument all but perspective, which takes as long as three others.

A central interval of probability p reaches norm.ppf((1 + p) / 2) standard deviations to either side. *Held*: share of
errors of single coordinates inside the intervals of 50, 80 and 95 %. Calibration error: mean of |share held - p| over p
= 5, 10, ..., 95 %. In these shares each case (take, trial, person, seed) counts the same. By chance: the calibration
error of exact intervals that is expected with cases that scatter as these do. Ratio: median of errors over
standard deviations, relative to a normal distribution; above 1, intervals are too narrow. Failures: results whose error
(the length of a vector) is above 50 mm, or, where there are fewer than 10 of these, above three times the median of
their quantity. Detection: the area under the curve of failures found over false alarms, when the length of the stated
deviation is the alarm; 0.5 is chance. Exact: the same for errors that are drawn from the stated deviations; where all
deviations are nearly equal, no detection is possible.
"""

import argparse
from collections.abc import Callable, Iterator

from bench.declaration import Bench
from bench.intervals import (
    of_bodies,
    of_bones,
    of_cameras,
    of_clicked_bodies,
    of_clocks,
    of_knees,
    of_motion,
    of_shapes,
    of_surface,
)
from bench.intervals.scoring import (
    SHOWN,
    Sample,
    by_quantity,
    calibration_error,
    chance,
    curve,
    detection,
    ratio,
    read_samples,
    write_samples,
)
from bench.recording import Column, Run, Table

BENCH = Bench(
    measures="Stated standard deviations of all capabilities against true errors, and failures that they show.",
    sources=(
        "src/marey/body",
        "src/marey/calibration",
        "src/marey/fit",
        "src/marey/knee",
        "src/marey/markers",
        "src/marey/motion",
        "src/marey/nonrigid",
        "src/marey/observations",
        "src/marey/pipelines/capture",
        "src/marey/pipelines/shape",
        "src/marey/surface",
    ),
    minutes=90,
)
CAPABILITIES: dict[str, Callable[[Run], Iterator[Sample]]] = {
    "bones": of_bones.samples,
    "cameras": of_cameras.samples,
    "clocks": of_clocks.samples,
    "one-camera": of_shapes.one_camera,
    "many-cameras": of_shapes.many_cameras,
    "perspective": of_shapes.perspective,
    "knee": of_knees.samples,
    "bodies": of_bodies.samples,
    "clicked-bodies": of_clicked_bodies.samples,
    "motion": of_motion.samples,
    "surface": of_surface.samples,
}
"""What gives the errors of each capability, light ones first."""
ONLY_BY_NAME = ("perspective",)
"""Capabilities that are measured only where they are named."""
COLUMNS = (
    Column("cases"), Column("errors"), Column("held by 50 %", "", 2), Column("80 %", "", 2), Column("95 %", "", 2),
    Column("calibration error", "", 3), Column("by chance", "", 3), Column("ratio", "", 2),
    Column("95 % of the worst case", "", 2), Column("failures"),
    Column("share", "", 3), Column("detection", "", 2), Column("exact", "", 2),
)  # fmt: skip

NOTE = (
    "*Held*: share of the errors of single numbers or coordinates within the stated central intervals of 50, 80 and "
    "95 %, normal distributions assumed. *Calibration error*: mean of |share held - p| over p = 5, 10, ..., 95 %. In "
    "these shares each case counts the same. *By chance*: what is expected of exact intervals with cases that scatter"
    " as these do. *Ratio*: median of errors over standard deviations, relative to a normal distribution; above 1, "
    "intervals are too narrow. *Failures*: results whose error is above 50 (mm) or, with fewer than ten of these, "
    "above three times the median. *Detection*: area under the curve of failures found over false alarms by the "
    "stated deviation; 0.5 is chance. *Exact*: the same for errors drawn from the stated deviations."
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("capabilities", nargs="*", type=capability, help=f"of {', '.join(CAPABILITIES)}")


def capability(word: str) -> str:
    """Check the name of a capability."""
    if word not in CAPABILITIES:
        raise argparse.ArgumentTypeError(f"there is no capability {word!r}; there are {', '.join(CAPABILITIES)}")
    return word


def run(run: Run) -> None:
    """Measure, and fill one table."""
    table = run.table("Stated intervals beside true errors", ("capability", "quantity"), *COLUMNS, note=NOTE)
    for name in run.arguments.capabilities or [each for each in CAPABILITIES if each not in ONLY_BY_NAME]:
        for samples in by_quantity(measured(run, name)):
            fill(table, name, samples)


def measured(run: Run, name: str) -> list[Sample]:
    """The errors of a capability, those of an earlier run of the same commit if they were kept."""
    kept = run.out / "intervals" / f"{name}.npz"
    if not kept.exists():
        write_samples(kept, list(CAPABILITIES[name](run)))
    return read_samples(kept)


def fill(table: Table, capability: str, samples: list[Sample]) -> None:
    """Append the row of one quantity."""
    shares, found = curve(samples, SHOWN), detection(samples)
    worst = min(curve([each], SHOWN)[-1] for each in samples)
    table.row(
        (capability, f"{samples[0].quantity} [{samples[0].unit}]"), len(samples),
        sum(each.error.size for each in samples), *shares, calibration_error(samples), chance(samples), ratio(samples),
        worst,
        f"above {found.limit:.3g}", found.share, found.auc, found.exact,
    )  # fmt: skip
