"""How the default method from skin markers to bones stands where nothing of it was chosen: three checks.

    python bench/markers_estimator.py SHARED --parts          random parts of real trials: other markers and references
    python bench/markers_estimator.py SHARED --leave-one-out  constants chosen on two real trials, judged on the third
    python bench/markers_estimator.py SHARED --made 60        random trials with made skin and known bones
    python bench/markers_estimator.py SHARED --kinds 10       the same of eight sorts, with sizes as in the collection
    python bench/markers_estimator.py SHARED --without        what it measures without one of its parts

Every figure is the knee's three angles' root mean square error against that of the rigid fit of the same trial with one
posture. The data: Cereatti et al. 2017, J Biomech, doi 10.1016/j.jbiomech.2017.02.004.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from made_skin_trials import KINDS, MadeTrial, made_trial

from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import rigid
from marey.markers.methods import joint_constraints
from marey.markers.methods.estimator import SkinAndJointsSettings, skin_and_joints
from marey.markers.methods.joint_constraints import JointLaxity, JointVariation
from marey.markers.methods.multiple_calibration import multiple_calibration
from marey.markers.methods.skin_motion import SkinMotionSettings, SkinVarianceShares
from marey.motion.anatomical import euler_angles

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
    """The share of errors that 1.96 stated standard deviations hold."""
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


def told(name: str, results: list[tuple[Judged, Judged]]) -> None:
    cells = []
    for posture in (0, 1):
        ratio = np.array([result[posture].against_rigid for result in results])
        share = np.mean([result[posture].held for result in results])
        worse = (ratio > 1.05).mean()
        cells.append(
            f"{ratio.mean():.2f} | {np.quantile(ratio, 0.9):.2f} | {ratio.max():.2f} | {worse:.2f} | {share:.2f}"
        )
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


HEAD = """| {} | one posture: mean | 90 % | worst | share above 1.05 | 95 % hold | two postures: mean | 90 % | worst | share above 1.05 | 95 % hold |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"""  # noqa: E501


@contextmanager
def knee_laxity(laxity: JointLaxity) -> Iterator[None]:
    """Work with another prior laxity of the knee."""
    table, before = joint_constraints._LAXITY, joint_constraints._LAXITY[KNEE]
    table[KNEE] = laxity
    try:
        yield
    finally:
        table[KNEE] = before


def scaled_knee(factor: float) -> JointLaxity:
    """The prior laxity of the knee with its small rotations scaled."""
    knee = joint_constraints._LAXITY[KNEE]
    return replace(
        knee, **{name: JointVariation(baseline_sd=g.baseline_sd * factor, rotation_sd=g.rotation_sd * factor)
                 for name in ("adduction", "rotation") if (g := getattr(knee, name))},
    )  # fmt: skip


def scaled_skin(factor: float) -> Callable[[MarkerProblem], BoneMotion]:
    """The default method with the prior of the skin's common motion scaled."""
    usual = SkinAndJointsSettings()
    settings = replace(
        usual, common_rotation_ratio=usual.common_rotation_ratio * factor,
        common_translation_ratio=usual.common_translation_ratio * factor,
    )  # fmt: skip
    return partial(skin_and_joints, settings=settings)


def without(shared: Path) -> None:
    """Take one part away at a time, on the real trials."""
    trials = [real_trial(shared, name) for name in TRIALS]
    knee = joint_constraints._LAXITY[KNEE]
    one_form = SkinAndJointsSettings(skin=SkinMotionSettings(candidates=(SkinVarianceShares(),)))

    def alone(problem: MarkerProblem) -> BoneMotion:
        return skin_and_joints(replace(problem, joints=()))

    free_centre = replace(knee, translation=JointVariation(baseline_sd=1.0, rotation_sd=1.0))
    cases = {
        "all of it": (skin_and_joints, knee),
        "no joint": (alone, knee),
        "joint's centre only": (skin_and_joints, replace(knee, adduction=None, rotation=None)),
        "joint's small turns only": (skin_and_joints, free_centre),
        "one form for every skin": (partial(skin_and_joints, settings=one_form), knee),
    }
    print("| | " + " | ".join(f"{name}: one, two" for name in TRIALS) + " | mean: one, two |")
    print("| --- | --- | --- | --- | --- |")
    for name, (method, joint) in cases.items():
        with knee_laxity(joint):
            both = np.array([[each.against_rigid for each in judge(trial, method)] for trial in trials])
        cells = " | ".join(f"{one:.2f}, {two:.2f}" for one, two in [*both, both.mean(0)])
        print(f"| {name} | {cells} |", flush=True)


def leave_one_out(shared: Path) -> None:
    """Choose both factors on two trials, judge them on the third."""
    trials = {name: real_trial(shared, name) for name in TRIALS}
    figures = {}
    print("| knee's small turns x | skin's common motion x | " + " | ".join(f"{n}: one, two" for n in TRIALS) + " |")
    print("| --- | --- | --- | --- | --- |")
    for joint in FACTORS:
        for skin in (0.7, 1.0, 1.4):
            with knee_laxity(scaled_knee(joint)):
                both = [judge(trial, scaled_skin(skin)) for trial in trials.values()]
            figures[joint, skin] = np.array([[each.against_rigid for each in pair] for pair in both])
            cells = " | ".join(f"{one:.2f}, {two:.2f}" for one, two in figures[joint, skin])
            print(f"| {joint} | {skin} | {cells} |", flush=True)
    for index, name in enumerate(TRIALS):
        best = min(figures, key=lambda key: np.delete(figures[key], index, 0).mean())
        one, two = figures[best][index]
        print(f"{name}: the other two choose {best}; with these {one:.2f} and {two:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("shared", type=Path)
    parser.add_argument("--parts", action="store_true")
    parser.add_argument("--leave-one-out", action="store_true")
    parser.add_argument("--without", action="store_true")
    parser.add_argument("--made", type=int, metavar="N")
    parser.add_argument("--kinds", type=int, metavar="N")
    parser.add_argument("--draws", type=int, default=20)
    given = parser.parse_args()
    if given.parts:
        print(HEAD.format(f"{given.draws} random parts of"))
        for name in TRIALS:
            rng, trial = np.random.default_rng(0), real_trial(given.shared, name)
            told(name, [judge(part_of(rng, trial), skin_and_joints) for _ in range(given.draws)])
    if given.without:
        without(given.shared)
    if given.leave_one_out:
        leave_one_out(given.shared)
    if given.made:
        print(HEAD.format(f"{given.made} made trials"))
        skin = skin_and_joints
        for name, method, joint in (
            ("default", skin, 1.0), ("knee twice as tight", skin, 0.5), ("rigid, calibration", calibrated, 1.0)
        ):  # fmt: skip
            rng = np.random.default_rng(0)
            with knee_laxity(scaled_knee(joint)):
                told(name, [judge(made_trial(rng), method) for _ in range(given.made)])
    if given.kinds:
        print(HEAD.format(f"{given.kinds} made trials of a sort"))
        for name, kind in KINDS.items():
            rng = np.random.default_rng(0)
            told(name, [judge(made_trial(rng, kind), skin_and_joints) for _ in range(given.kinds)])


if __name__ == "__main__":
    main()
