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
from itertools import product
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
TRIALS = (
    "lmam_treadmill_walking", "ottawa_walking", "unibo_step_up", "csuohio_running", "foroit_hip_knee_flexion",
    "ntu_walking",
)  # fmt: skip
ADDUCTIONS = (3.5, 5.0, 7.0)
"""Standard deviations of the knee's adduction at 45 degrees of flexion that are compared [deg]."""
ROTATIONS = ((5.0, 6.5), (5.0, 9.0), (4.0, 6.5), (4.0, 9.0))
"""The same of its rotation, at any time and at 45 degrees of flexion [deg]."""
GROWTHS = (1.0, 2.0)
"""Powers of flexion with which these variances grow."""
MADE_FOR_CHOICE = 6
"""Made trials of each kind that take part in a choice."""
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
    angles = euler_angles(np.swapaxes(thigh, 1, 2) @ shank, "ZXY")
    known = np.isfinite(angles).all(1)
    angles[known] = np.unwrap(angles[known], axis=0)
    return angles


def knee_error(trial: MadeTrial, motion: BoneMotion) -> float:
    true = knee(*(trial.bones[s][0] for s in KNEE))
    error = knee(*(motion.bone(s)[0] for s in KNEE)) - true
    error = error[np.isfinite(error).all(1)]
    error -= 2 * np.pi * np.round(error.mean(0) / (2 * np.pi))
    return float(np.degrees(np.sqrt((error**2).mean())))


def held(trial: MadeTrial, motion: BoneMotion) -> float:
    """The share of errors within 1.96 stated standard deviations, where there is a result."""
    inside = []
    for index, name in enumerate(motion.segments):
        rotation, origin = trial.bones[name]
        turn = rotations.log(np.swapaxes(motion.rotation[:, index], 1, 2) @ rotation)
        shown = np.isfinite(turn).all(1)
        inside.append((np.abs(turn) <= 1.96 * motion.rotation_sd[:, index])[shown])
        inside.append((np.abs(origin - motion.origin[:, index]) <= 1.96 * motion.origin_sd[:, index])[shown])
    return float(np.concatenate(inside).mean())


def judge(trial: MadeTrial, method: Callable[[MarkerProblem], BoneMotion]) -> tuple[Judged, Judged]:
    base = knee_error(trial, rigid(trial.problem(1)))
    one, two = (method(trial.problem(postures)) for postures in (1, 2))
    return tuple(Judged(against_rigid=knee_error(trial, m) / base, held=held(trial, m)) for m in (one, two))


def calibrated(problem: MarkerProblem) -> BoneMotion:
    return multiple_calibration(problem) if problem.calibration.postures > 1 else rigid(problem)


def part_of(rng: np.random.Generator, trial: MadeTrial) -> MadeTrial:
    """Another reference frame, up to 120 frames from it to the farther end, 4 to 12 of the markers of a segment."""
    count = len(trial.flexion)
    whole = np.isfinite(np.concatenate([*trial.points.values()], 1)).all((1, 2)) & np.isfinite(trial.flexion)
    first = int(rng.choice(np.flatnonzero(whole)))
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


def coupled_knee(adduction: float, rotation: tuple[float, float], growth: float = 2.0) -> JointLaxity:
    """Return the prior laxity of the knee with other standard deviations of its small rotations [deg].

    Args:
        adduction: Standard deviation of adduction at 45 degrees of flexion.
        rotation: Standard deviation of rotation at any time, and at 45 degrees of flexion.
        growth: Power of flexion with which the variances grow.
    """
    knee = SkinAndJointsSettings().joints.laxity[KNEE]
    radians = np.radians
    return replace(
        knee, adduction=replace(knee.adduction, rotation_sd=float(radians(adduction)), growth=growth),
        rotation=replace(
            knee.rotation, baseline_sd=float(radians(rotation[0])), rotation_sd=float(radians(rotation[1])),
            growth=growth,
        ),
    )  # fmt: skip


def leave_one_out(run: Run) -> None:
    """Choose the laxity of the knee without one real trial, and judge it on that trial, with one posture.

    The choice has the smallest sum of the mean and the largest of the ratios to the rigid fit, over the other five real
    trials and the made ones: a method must not be worse than the rigid fit in a single activity.
    """
    trials = [real_trial(run.shared, name) for name in TRIALS]
    made = []
    for kind in KINDS.values():
        rng = np.random.default_rng(77)
        made += [made_trial(rng, kind) for _ in range(MADE_FOR_CHOICE)]
    laxities = [coupled_knee(*each, growth) for growth in GROWTHS for each in product(ADDUCTIONS, ROTATIONS)]
    figures, of_made, holds = [], [], []
    table = run.table(
        "Laxity of the knee, error relative to the rigid fit with one posture",
        ("adduction at 45 deg [deg]", "rotation at any time, at 45 deg [deg]", "growth"),
        *(Column(name, "", 2) for name in TRIALS), Column("mean", "", 3), Column("worst", "", 2),
        Column("made: mean", "", 3), Column("made: worst", "", 2), Column("95 % hold", "", 2),
    )  # fmt: skip
    for laxity in laxities:
        method = partial(skin_and_joints, settings=with_knee(laxity))
        own = [judge_once(trial, method) for trial in trials]
        figures.append([each.against_rigid for each in own])
        holds.append([each.held for each in own])
        of_made.append([judge_once(trial, method).against_rigid for trial in made])
        real = np.array(figures[-1])
        cells = (real.mean(), real.max(), np.mean(of_made[-1]), max(of_made[-1]), np.mean(holds[-1]))
        table.row(laxity_labels(laxity), *real, *cells)
    held_out = run.table(
        "Laxity chosen without the trial",
        ("trial", "adduction at 45 deg [deg]", "rotation at any time, at 45 deg [deg]", "growth"),
        Column("against rigid", "", 2), Column("95 % hold", "", 2),
    )  # fmt: skip
    for index, name in enumerate(TRIALS):
        others = np.concatenate([np.delete(np.array(figures), index, 1), np.array(of_made)], 1)
        best = int(np.argmin(others.mean(1) + others.max(1)))
        held_out.row((name, *laxity_labels(laxities[best])), figures[best][index], holds[best][index])


def laxity_labels(laxity: JointLaxity) -> tuple[str, str, str]:
    """Return the labels of a knee's laxity: of adduction, of rotation, and the power of their growth."""
    adduction, rotation = laxity.adduction, laxity.rotation
    two = f"{np.degrees(rotation.baseline_sd):.1f}, {np.degrees(rotation.rotation_sd):.1f}"
    return f"{np.degrees(adduction.rotation_sd):.1f}", two, f"{rotation.growth:.0f}"


def judge_once(trial: MadeTrial, method: Callable[[MarkerProblem], BoneMotion]) -> Judged:
    """Judge a method on a trial with one posture."""
    problem = trial.problem(1)
    motion = method(problem)
    return Judged(
        against_rigid=knee_error(trial, motion) / knee_error(trial, rigid(problem)), held=held(trial, motion)
    )


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
