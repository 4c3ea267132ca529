"""Hips of captured takes with and without lengths that were measured on the person.

Leg length and distance of the spines (`--leg-length`, `--asis-distance`) are those that give the true distances of the
rendered person's joint centres by the regressions that marey uses, with drawn errors of a tape. They show what a
measured length is worth, not how well the regressions fit people.
"""

import argparse
from pathlib import Path

import numpy as np

import marey
from bench.common.program import capture, empty_frames, score, take, truth_of
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.body.people.known_lengths import LEG_SD, SPINES_SD, hip_distance, hip_to_ankle

BENCH = Bench(
    measures="Hips of captured takes with and without a measured leg length and distance of the spines.",
    sources=("src/marey/body/people", "src/marey/fit", "src/marey/pipelines/capture"),
    minutes=10,
)
TAKES = ("walk", "reach", "stealth", "jacks")
SEED = 1
"""Seed of the errors of the tape."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help=f"of {', '.join(TAKES)}")


def run(run: Run) -> None:
    """Capture every take twice, and compare its hips with the truth."""
    table = run.table(
        "Hips",
        ("take", "measured"),
        Column("error of leg length", "mm", 0),
        Column("error of ASIS distance", "mm", 0),
        Column("hips", "mm", 1),
        Column("up", "mm", 1),
        Column("to the side", "mm", 1),
        Column("stated sd per axis", "mm", 1),
        Column("joints", "mm", 1),
        Column("steady", "mm", 1),
        note="Constant offsets of the hips in the pelvis, mean of both sides. *Joints*: mean of the limb joints.",
    )
    random = np.random.default_rng(SEED)
    for name in run.arguments.takes or TAKES:
        trial, out = take(run, name)
        table.row((name, "nothing"), None, None, *judged(run, trial, out))
        truth = joints_of(trial)
        leg_error, spines_error = random.normal(size=2) * (LEG_SD, SPINES_SD)
        leg, spines = tape(truth, leg_error, spines_error)
        known = capture(trial, run.out / "known" / name, leg_length=leg, asis_distance=spines)
        table.row(
            (name, "leg length and ASIS distance"), 1e3 * leg_error, 1e3 * spines_error, *judged(run, trial, known)
        )


def joints_of(trial: Path) -> dict[str, np.ndarray]:
    """Return the true joint centres (F, 3) by name."""
    truth = np.load(truth_of(trial))
    return {str(name): truth["joints"][:, k] for k, name in enumerate(truth["joint_names"])}


def tape(truth: dict[str, np.ndarray], leg_error: float, spines_error: float) -> tuple[float, float]:
    """Return leg length and distance of the spines [m] that give true distances plus errors by the regressions."""

    def length(first: str, second: str) -> float:
        return float(np.median(np.linalg.norm(truth[first] - truth[second], axis=1)))

    leg = np.mean([length(f"{s}_hip", f"{s}_knee") + length(f"{s}_knee", f"{s}_ankle") for s in "lr"]) + leg_error
    wide = length("l_hip", "r_hip") + spines_error
    # Both regressions are linear in what is measured.
    leg_length = (leg - hip_to_ankle(0.0)) / (hip_to_ankle(1.0) - hip_to_ankle(0.0))
    spines = (wide - hip_distance(0.0)) / (hip_distance(1.0) - hip_distance(0.0))
    return float(leg_length), float(spines)


def judged(run: Run, trial: Path, out: Path) -> tuple[float, ...]:
    """Return hips' offset, its part up and to the side, the stated deviation, and the errors of all joints [mm]."""
    truth, motion, body = np.load(truth_of(trial)), np.load(out / "motion.npz"), marey.load_body(out)
    first = int(empty_frames(trial))
    pelvis = truth["bone_rotation"][:, [str(name) for name in truth["limb_names"]].index("Hips")]
    true, own = joints_of(trial), [str(name) for name in motion["joint_names"]]
    offsets = []
    apart = np.einsum("fij,fi->fj", pelvis, true["l_hip"] - true["r_hip"])[:, 0]
    for side, outwards in (("left", np.sign(np.median(apart))), ("right", -np.sign(np.median(apart)))):
        found = motion["joint_centres"][first : first + len(pelvis), own.index(f"{side}_hip")]
        error = np.einsum("fij,fi->fj", pelvis[: len(found)], found - true[f"{side[0]}_hip"][: len(found)])
        offsets.append(np.nanmean(error, axis=0) * (outwards, 1.0, 1.0))
    mean = 1e3 * np.mean(offsets, axis=0)
    assert body.joint_offset_sd is not None
    stated = 1e3 * body.joint_offset_sd[body.skeleton.segment("left_thigh")]
    numbers = score(run, "capture.py", out, truth_of(trial), "--skip-empty", first)
    whole = 1e3 * float(np.mean(np.linalg.norm(offsets, axis=1)))
    return whole, float(mean[2]), float(mean[0]), float(stated), numbers["joint_mm"], numbers["own_steady_mm"]
