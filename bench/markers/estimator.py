"""The default method from skin markers to bones where none of its constants was chosen: three checks.

`parts`: random parts of real trials, with other markers and references. `made`: random trials with made skin and
known bones. `kinds`: the same of eight kinds of activity, with sizes as in the collection. `leave-one-out`: constants
chosen on two real trials, evaluated on the third. `without`: the method without one of its parts. Every figure is the
root mean square error of the knee's three angles, divided by that of the rigid fit of the same trial with one
posture. The data: Cereatti et al. 2017, J Biomech, doi 10.1016/j.jbiomech.2017.02.004.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.markers.made_skin_trials import KINDS, MadeTrial, made_trial
from bench.recording import Column, Run, Table
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import rigid
from marey.markers.methods.estimator import SkinAndJointsSettings, skin_and_joints
from marey.markers.methods.joint_constraints import JointLaxity, JointVariation
from marey.markers.methods.multiple_calibration import multiple_calibration
from marey.markers.methods.skin_motion import SkinMotionSettings, SkinVarianceShares
from marey.motion.anatomical import euler_angles

BENCH = Bench(
    measures="Knee angles of the default method on parts of real trials and on made ones, relative to the rigid fit.",
    sources=("src/marey/markers", "src/marey/motion", "src/marey/geometry"),
    minutes=8,
)
TRIALS = ("lmam_treadmill_walking", "ottawa_walking", "unibo_step_up")
FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)
KNEE = ("thigh", "shank")


@dataclass(frozen=True, kw_only=True)
class Judged:
    """One method on one trial, with one posture or two."""

    against_rigid: float
    held: float


def real_trial(shared: Path, name: str) -> MadeTrial:
    truth = np.load(shared / "data" / "markers" / "sta" / f"{name}.npz")
    bones = {s: (truth[f"{s}_rotation"], truth[f"{s}_origin"] / 1000) for s in KNEE}
    points = {
        s: np.einsum("fij,fmj->fmi", bones[s][0], truth[f"{s}_markers"] / 1000) + bones[s][1][:, None] for s in KNEE
    }
    flexion = knee(bones["thigh"][0], bones["shank"][0])[:, 0]
    return MadeTrial(bones=bones, points=points, rate=float(truth["rate"]), flexion=flexion)


def knee(thigh: np.ndarray, shank: np.ndarray) -> np.ndarray:
    return np.unwrap(euler_angles(np.swapaxes(thigh, 1, 2) @ shank, "ZXY"), axis=0)


def knee_error(trial: MadeTrial, motion: BoneMotion) -> float:
    true = knee(*(trial.bones[s][0] for s in KNEE))
    error = knee(*(motion.bone(s)[0] for s in KNEE)) - true
    error -= 2 * np.pi * np.round(error.mean(0) / (2 * np.pi))
    return float(np.degrees(np.sqrt((error**2).mean())))


def held(trial: MadeTrial, motion: BoneMotion) -> float:
    """The share of errors within 1.96 stated standard deviations."""
    inside = []
    for index, name in enumerate(motion.segments):
        rotation, origin = trial.bones[name]
        turn = rotations.log(np.swapaxes(motion.rotation[:, index], 1, 2) @ rotation)
        inside.append(np.abs(turn) <= 1.96 * motion.rotation_sd[:, index])
        inside.append(np.abs(origin - motion.origin[:, index]) <= 1.96 * motion.origin_sd[:, index])
    return float(np.mean(inside))


def judge(trial: MadeTrial, method: Callable[[MarkerProblem], BoneMotion]) -> tuple[Judged, Judged]:
    base = knee_error(trial, rigid(trial.problem(1)))
    one, two = (method(trial.problem(postures)) for postures in (1, 2))
    return tuple(Judged(against_rigid=knee_error(trial, m) / base, held=held(trial, m)) for m in (one, two))


def calibrated(problem: MarkerProblem) -> BoneMotion:
    return multiple_calibration(problem) if problem.calibration.postures > 1 else rigid(problem)


def part_of(rng: np.random.Generator, trial: MadeTrial) -> MadeTrial:
    """Another reference frame, up to 120 frames from it to the farther end, 4 to 12 of the markers of a segment."""
    count = len(trial.flexion)
    first = int(rng.integers(count))
    frames = np.arange(first, count) if count - first > first else np.arange(first, -1, -1)
    step = max(len(frames) // 120, 1)
    frames = frames[::step]
    bones = {s: (r[frames], o[frames]) for s, (r, o) in trial.bones.items()}
    points = {s: p[frames][:, some_markers(rng, p[first])] for s, p in trial.points.items()}
    return MadeTrial(bones=bones, points=points, rate=trial.rate / step, flexion=trial.flexion[frames])


def some_markers(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Draw 4 to 12 markers that do not lie near one line."""
    if len(points) <= 4:
        return np.arange(len(points))
    while True:
        chosen = np.sort(rng.choice(len(points), rng.integers(4, min(len(points), 12) + 1), replace=False))
        spread = np.linalg.svd(points[chosen] - points[chosen].mean(0), compute_uv=False)
        if spread[1] > 0.02 * np.sqrt(len(chosen)):
            return chosen


def begin(run: Run, title: str) -> Table:
    """Begin a table of errors relative to the rigid fit."""
    columns = [
        Column(f"{posture} posture{'s' * (posture > 1)}: {what}", "", 2)
        for posture in (1, 2)
        for what in ("mean", "90 % below", "worst", "share above 1.05", "95 % hold")
    ]
    return run.table(title, "trials", *columns)


def fill(table: Table, name: str, results: list[tuple[Judged, Judged]]) -> None:
    """Append a row."""
    cells = []
    for posture in (0, 1):
        ratio = np.array([result[posture].against_rigid for result in results])
        share = np.mean([result[posture].held for result in results])
        cells += [ratio.mean(), np.quantile(ratio, 0.9), ratio.max(), (ratio > 1.05).mean(), share]
    table.row(name, *cells)


def with_knee(laxity: JointLaxity) -> SkinAndJointsSettings:
    """Return the settings of the default method with another prior laxity of the knee."""
    usual = SkinAndJointsSettings()
    return replace(usual, joints=replace(usual.joints, laxity={**usual.joints.laxity, KNEE: laxity}))


def scaled_knee(factor: float) -> JointLaxity:
    """Return the prior laxity of the knee with its small rotations scaled."""
    knee = SkinAndJointsSettings().joints.laxity[KNEE]
    return replace(
        knee, **{name: JointVariation(baseline_sd=g.baseline_sd * factor, rotation_sd=g.rotation_sd * factor)
                 for name in ("adduction", "rotation") if (g := getattr(knee, name))},
    )  # fmt: skip


def scaled(skin: float = 1.0, joint: float = 1.0) -> Callable[[MarkerProblem], BoneMotion]:
    """Return the default method with the priors of the skin's common motion and of the knee's rotations scaled."""
    usual = with_knee(scaled_knee(joint))
    settings = replace(
        usual, common_rotation_ratio=usual.common_rotation_ratio * skin,
        common_translation_ratio=usual.common_translation_ratio * skin,
    )  # fmt: skip
    return partial(skin_and_joints, settings=settings)


def without(run: Run) -> None:
    """Take one part away at a time, on the real trials."""
    trials = [real_trial(run.shared, name) for name in TRIALS]
    knee = SkinAndJointsSettings().joints.laxity[KNEE]
    one_form = SkinAndJointsSettings(skin=SkinMotionSettings(candidates=(SkinVarianceShares(),)))

    def alone(problem: MarkerProblem) -> BoneMotion:
        return skin_and_joints(replace(problem, joints=()))

    def held_by(laxity: JointLaxity) -> Callable[[MarkerProblem], BoneMotion]:
        return partial(skin_and_joints, settings=with_knee(laxity))

    free_centre = replace(knee, translation=JointVariation(baseline_sd=1.0, rotation_sd=1.0))
    cases = {
        "the whole method": skin_and_joints,
        "no joint": alone,
        "joint's centre only": held_by(replace(knee, adduction=None, rotation=None)),
        "joint's small turns only": held_by(free_centre),
        "one form for every skin": partial(skin_and_joints, settings=one_form),
    }
    table = by_trial(run, "Without one part of the method", "method", ("mean",))
    for name, method in cases.items():
        both = np.array([[each.against_rigid for each in judge(trial, method)] for trial in trials])
        table.row(name, *[f"{one:.2f}, {two:.2f}" for one, two in [*both, both.mean(0)]])


def by_trial(run: Run, title: str, labels: str | tuple[str, ...], more: tuple[str, ...] = ()) -> Table:
    """Begin a table with one column per trial."""
    columns = [Column(f"{name}: one posture, two") for name in (*TRIALS, *more)]
    return run.table(title, labels, *columns)


def leave_one_out(run: Run) -> None:
    """Choose both factors on two trials, judge them on the third."""
    trials = {name: real_trial(run.shared, name) for name in TRIALS}
    figures = {}
    table = by_trial(run, "Factors of the method's constants", ("knee's small turns x", "skin's common motion x"))
    for joint in FACTORS:
        for skin in (0.7, 1.0, 1.4):
            both = [judge(trial, scaled(skin, joint)) for trial in trials.values()]
            figures[joint, skin] = np.array([[each.against_rigid for each in pair] for pair in both])
            table.row((str(joint), str(skin)), *[f"{one:.2f}, {two:.2f}" for one, two in figures[joint, skin]])
    chosen = run.table(
        "Factors that the other two trials choose", "trial", Column("knee's small turns x"),
        Column("skin's common motion x"), Column("one posture", "", 2), Column("two postures", "", 2),
    )  # fmt: skip
    for index, name in enumerate(TRIALS):
        best = min(figures, key=lambda key: np.delete(figures[key], index, 0).mean())
        chosen.row(name, *best, *figures[best][index])


def parts(run: Run) -> None:
    """Judge the method on random parts of the real trials."""
    table = begin(run, f"{run.arguments.draws} random parts of each trial")
    for name in TRIALS:
        rng, trial = np.random.default_rng(0), real_trial(run.shared, name)
        fill(table, name, [judge(part_of(rng, trial), skin_and_joints) for _ in range(run.arguments.draws)])


def made(run: Run) -> None:
    """Judge the method, a tighter knee and simpler methods on made trials."""
    count = run.arguments.made
    table = begin(run, f"{count} made trials of any kind")
    for name, method in (
        ("default", skin_and_joints), ("knee held twice as tightly", scaled(joint=0.5)),
        ("rigid; with two postures `calibration`", calibrated),
    ):  # fmt: skip
        rng = np.random.default_rng(0)
        fill(table, name, [judge(made_trial(rng), method) for _ in range(count)])


def kinds(run: Run) -> None:
    """Judge the method on made trials of each kind of activity."""
    table = begin(run, f"{run.arguments.kinds} made trials of each kind")
    for name, kind in KINDS.items():
        rng = np.random.default_rng(0)
        results = [judge(made_trial(rng, kind), skin_and_joints) for _ in range(run.arguments.kinds)]
        fill(table, name, results)


PARTS = {"parts": parts, "made": made, "kinds": kinds, "leave-one-out": leave_one_out, "without": without}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)
    parser.add_argument("--draws", type=int, default=16, help="random parts per trial")
    parser.add_argument("--made", type=int, default=60, help="made trials")
    parser.add_argument("--kinds", type=int, default=12, help="made trials of each kind")


def run(run: Run) -> None:
    """Judge the method."""
    run_parts(run, PARTS)
