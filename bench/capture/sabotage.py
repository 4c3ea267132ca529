"""Takes in which one thing is wrong, and sound ones: whether the cause is named, and how far the joints are off.

Each sabotaged take has one fault of its cameras, videos, images of the empty room, people or body. A row states the
verdict, the causes that it names (of an error its line), the mean joint error, the shares of joint coordinates that the
stated 95 % intervals hold, and a judgement: `repaired`, the right cause is named, and the intervals hold at least 85 %
in the limb's frame; `named`, it is named only; `covered`, it is not named, but the intervals hold 85 %; `missed`,
neither. Where a second person is in view, either one may be captured. The frames are those of camera 1: where it is
late, the joints are compared with the truth at its pictures.
Thresholds of the checks were chosen on `walk` and `reach`; `jacks` and `stealth` are held out.

Sound takes are parts of the recordings without a fault: none should be unusable.
"""

import argparse
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import marey
from bench.common.program import capture, empty_frames, score, truth_of
from bench.common.sabotaged_takes import (
    Fault,
    TakeCopy,
    cut_below,
    darker,
    each,
    empty_room,
    exchanged_plates,
    filmed,
    in_order,
    in_unit,
    joined_at,
    late,
    later,
    losing,
    plates_of,
    second_person,
    small,
    turned,
    with_cameras,
    zoomed,
)
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.pipelines.verdict import Verdict

BENCH = Bench(
    measures="Whether planted faults of takes are named or repaired, and whether sound takes are called unusable.",
    sources=("src/marey/fit/consistency", "src/marey/pipelines/consistency", "src/marey/pipelines/verdict.py"),
    minutes=30,
)
LEAST_HELD = 0.85
"""Least share of coordinates in the stated 95 % intervals for which these cover a fault."""

FAULTS = (
    Fault(take="walk", name="calibrations 1, 2 exchanged", plant=in_order(1, 0, 2, 3), causes=("exchanged",)),
    Fault(
        take="jacks", name="calibrations 1, 2, 3 in another order", plant=in_order(1, 2, 0, 3), causes=("exchanged",)
    ),
    Fault(take="reach", name="camera 3 late by 1 frame", plant=filmed(late(1), 2), causes=("late",)),
    Fault(take="stealth", name="camera 2 late by 1 frame", plant=filmed(late(1), 1), causes=("late",)),
    Fault(take="walk", name="camera 3 late by 3 frames", plant=filmed(late(3), 2), causes=("late",)),
    Fault(take="jacks", name="camera 1 late by 3 frames", plant=filmed(late(3), 0), causes=("late",), ahead=-3),
    Fault(take="reach", name="camera 3 late by 10 frames", plant=filmed(late(10), 2), causes=("late",)),
    Fault(take="stealth", name="camera 4 late by 10 frames", plant=filmed(late(10), 3), causes=("late",)),
    Fault(take="walk", name="camera 2 loses 8 frames", plant=filmed(losing(8, 55), 1), causes=("break",)),
    Fault(
        take="jacks",
        name="two recordings joined in camera 3",
        plant=filmed(joined_at(35), 2),
        causes=("break",),
        frames=range(10, 60),
    ),
    Fault(
        take="reach",
        name="pictures of 3 mirrored",
        plant=filmed(each(lambda image: image[:, ::-1]), 2),
        causes=("mirrored",),
    ),
    Fault(
        take="stealth",
        name="pictures of 2 mirrored",
        plant=filmed(each(lambda image: image[:, ::-1]), 1),
        causes=("mirrored",),
    ),
    Fault(
        take="jacks",
        name="pictures of 3 turned by 180 deg",
        plant=filmed(each(lambda image: image[::-1, ::-1]), 2),
        causes=("turned",),
    ),
    Fault(
        take="walk",
        name="pictures of 2 turned by 90 deg",
        plant=filmed(each(np.rot90), 1),
        causes=("turned",),
        words="turned by 90 degrees|rotated",
    ),
    Fault(
        take="reach",
        name="calibration in millimetres",
        plant=with_cameras(lambda camera: in_unit(camera, 1000)),
        causes=("unit",),
        words="millimetre",
    ),
    Fault(
        take="walk",
        name="focal length of 2 20 % off",
        plant=with_cameras(lambda camera: zoomed(camera, 1.2), 1),
        causes=("focal length",),
    ),
    Fault(
        take="stealth",
        name="focal length of all 20 % off",
        plant=with_cameras(lambda camera: zoomed(camera, 1.2)),
        causes=("focal length",),
    ),
    Fault(
        take="reach",
        name="video 2 has half of the size",
        plant=filmed(each(small), 1),
        causes=("size",),
        words="320 x 240.*640 x 480",
    ),
    Fault(
        take="jacks",
        name="all videos have half of the size",
        plant=filmed(each(small)),
        causes=("size",),
        words="320 x 240.*640 x 480",
    ),
    Fault(
        take="walk",
        name="camera 2 moved by 5 deg",
        plant=with_cameras(lambda camera: turned(camera, 5.0), 1),
        causes=("moved",),
    ),
    Fault(
        take="stealth",
        name="camera 3 moved by 5 deg",
        plant=with_cameras(lambda camera: turned(camera, 5.0, (0.0, 1.0, 0.0)), 2),
        causes=("moved",),
    ),
    Fault(take="jacks", name="plates 1, 2 exchanged", plant=exchanged_plates, causes=("empty room",)),
    Fault(
        take="reach", name="plate 1 at another light", plant=lambda copy: copy.light(0, darker), causes=("empty room",)
    ),
    Fault(take="stealth", name="plates of another room", plant=plates_of("walk"), causes=("empty room",)),
    Fault(take="reach", name="body of another person", causes=("body",), body_of="walk"),
    Fault(
        take="jacks",
        name="body of another person, sizes kept",
        causes=("body",),
        body_of="walk",
        settings={"fixed_sizes": True},
    ),
    Fault(take="walk", name="two people", plant=second_person(40), causes=("several people",), ahead=40),
    Fault(
        take="stealth",
        name="two people",
        plant=second_person(80),
        causes=("several people",),
        ahead=80,
        frames=range(10, 50),
    ),
    Fault(take="jacks", name="nobody", plant=empty_room, causes=("nobody",), words="no person"),
    Fault(take="reach", name="half of the body", plant=cut_below(284), causes=("cut off",)),
    Fault(
        take="walk",
        name="calibrations 1, 2 equal",
        plant=in_order(0, 0, 2, 3),
        causes=("equal",),
        words="at the same place",
    ),
    Fault(
        take="jacks",
        name="four equal calibrations",
        plant=in_order(0, 0, 0, 0),
        causes=("equal",),
        words="at the same place",
    ),
)
"""The sabotaged takes, each with one fault."""


def in_parts(take: str, *firsts: int, count: int = 40, keypoints: bool = False) -> Iterator[Fault]:
    """List parts of a sound take."""
    for first in firsts:
        yield Fault(take=take, name="none", causes=(), frames=range(first, first + count), keypoints=keypoints)


SOUND = (
    *in_parts("walk", 10, 30, 50, 69),
    *in_parts("reach", 10, 30, 50, 70, 90),
    *in_parts("jacks", 10, 30, 50, 70, 90),
    *in_parts("stealth", 10, 30, 50, 70, 90),
    *in_parts("clocks", 6, 40, count=50),
    *in_parts("balancing", 0, 60, count=30),
    *in_parts("seated", 120, 300),
    *in_parts("walk", 40, count=20, keypoints=True),
    *in_parts("jacks", 40, count=20, keypoints=True),
    *in_parts("market", 30, count=30, keypoints=True),
    *in_parts("office", 30, 70, count=30, keypoints=True),
)
"""Sound parts of takes."""


def scores(run: Run, fault: Fault, place: Path) -> tuple[float, float, float] | None:
    """Return joint error [mm] and shares held [%] of a motion, against the nearest person; None without truth."""
    truth = truth_of(run.shared / "data" / "people" / fault.take)
    if not truth.exists():
        return None
    found = []
    for ahead in {0, fault.ahead}:
        reference = truth if not ahead else later(truth, ahead, place / "later.npz")
        found.append(
            score(run, "capture.py", place / "out", reference, "--skip-empty", empty_frames(truth.parent.parent))
        )
    best = min(found, key=lambda each: each["joint_mm"])
    held = [best.get(key) for key in ("covered_95", "own_covered_95")]
    return best["joint_mm"], *(100 * share if share is not None else float("nan") for share in held)


def captured(run: Run, fault: Fault) -> tuple[Path, Verdict | str]:
    """Capture a take with a fault; its results, and the verdict or the error.

    Args:
        run: The run.
        fault: The fault.

    Returns:
        The folder with the results in `out`, and the verdict, or the line of an error.
    """
    take = run.shared / "data" / "people" / fault.take
    span = f"{fault.frames.start}-{fault.frames.stop}"
    kind = "keypoints" if fault.keypoints else ""
    place = run.out / "sabotage" / re.sub(r"\W+", "-", f"{fault.take} {fault.name} {span} {kind}")
    record = place / "out" / "run.json"
    if not record.exists():
        settings = dict(fault.settings)
        if fault.keypoints:
            settings["keypoints"] = take / "keypoints"
        if fault.body_of:
            settings["body"] = body_of(run, fault.body_of)
        trial = place / "trial"
        fault.plant(TakeCopy.of(take, trial))
        try:
            capture(trial, place / "out", frames=fault.frames, **settings)
        except marey.NotUsable as problem:
            return place, problem.verdict
        except marey.MareyError as problem:
            return place, str(problem).replace(str(trial), fault.take)
    verdict = Verdict.from_record(json.loads(record.read_text()))
    assert verdict is not None
    return place, verdict


def body_of(run: Run, take: str) -> Path:
    """Return the captured body of another person."""
    other = next(each for each in SOUND if each.take == take)
    return captured(run, other)[0] / "out" / "body.npz"


def row_of(run: Run, table: Table, fault: Fault) -> None:
    """Capture a take with a fault, and judge what was captured and named."""
    place, found = captured(run, fault)
    labels = (fault.take, f"{fault.frames.start} to {fault.frames.stop - 1}", fault.name)
    if isinstance(found, str):
        right = bool(fault.words) and re.search(fault.words, found) is not None
        run.report(f"  {found}")
        table.row(labels, "error", found, None, None, None, "named" if right else "missed")
        return
    for reason in found.reasons:
        run.report(f"  {reason}")
    values = scores(run, fault, place) if (place / "out" / "motion.npz").exists() else None
    causes = tuple(dict.fromkeys(reason.cause for reason in found.reasons if reason.cause))
    held = None if values is None else values[2]
    table.row(labels, found.level, ", ".join(causes) or "-", *(values or (None,) * 3), judged(fault, causes, held))


def judged(fault: Fault, causes: Sequence[str], held: float | None) -> str:
    """Return the judgement on a fault.

    Args:
        fault: The fault.
        causes: The causes that are named.
        held: Share of coordinates in the limb's frame that the intervals hold [%]; None without a motion.
    """
    covered = held is not None and held >= 100 * LEAST_HELD
    if not fault.causes:
        return "sound"
    if not set(causes) & set(fault.causes):
        return "covered" if covered else "missed"
    return "repaired" if covered else "named"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("part", nargs="?", choices=("faults", "sound"), help="both without one")
    parser.add_argument("--take", default="", help="only this take")
    parser.add_argument("--only", default="", help="only faults whose name contains this")


def run(run: Run) -> None:
    """Capture the takes with faults, and the sound ones."""
    columns = (
        Column("verdict"), Column("causes named"), Column("joints", "mm", 1), Column("held", "%", 0),
        Column("held, in the limb's frame", "%", 0),
    )  # fmt: skip
    given = run.arguments
    for part, title, chosen in (("faults", "Planted faults", FAULTS), ("sound", "Sound takes", SOUND)):
        if given.part not in (None, part):
            continue
        table = run.table(title, ("take", "frames", "fault"), *columns, Column("judgement"))
        for fault in chosen:
            if given.take in ("", fault.take) and given.only in fault.name:
                row_of(run, table, fault)
