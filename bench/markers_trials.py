"""Every method from skin markers to bones on the real trials with true bones, beside the rigid fit.

    python bench/markers_trials.py SHARED [--methods NAME ...] [--trials NAME ...]
    python bench/markers_trials.py SHARED --exercise

The fair protocol: the bones are known in the first frame alone, or in that frame and the one farthest from it in knee
flexion. Prints a table a trial: degrees RMS of thigh and shank (turn) and of the knee's three angles, their root mean
square, that against the rigid fit with one posture, and the share of true errors that 1.96 stated standard deviations
hold; at the end all trials in one table, each cell thigh / shank; the knee's angles; these together. The figures are
those of score/bones.py. `--exercise`: artefact assessment on the treadmill alone, skin learned from the first stride
with the true bones, the other strides as the activity. The data: Cereatti et al. 2017, J Biomech,
doi 10.1016/j.jbiomech.2017.02.004.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import ezc3d
import numpy as np
from scipy.spatial.transform import Rotation

from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.trajectories import trajectories
from marey.markers.methods.methods import METHODS, choose_methods

MM = 1000.0


def read_trial(folder: Path, name: str) -> tuple[MarkerProblem, MarkerProblem]:
    """The same trial with one known posture, and with two."""
    truth = np.load(folder / f"{name}.npz")
    points = ezc3d.c3d(str(folder / f"{name}.c3d"))
    labels = points["parameters"]["POINT"]["LABELS"]["value"]
    places = points["data"]["points"][:3].transpose(2, 1, 0) / MM
    segments = [str(segment) for segment in truth["segments"]]
    clusters = tuple(
        Cluster(segment=s, labels=tuple(label for label in labels if label.rsplit("_", 1)[0] == s)) for s in segments
    )
    joints = (("thigh", "shank"),) if {"thigh", "shank"} <= set(segments) else ()
    problems = []
    for frames in ([0], [0, farthest(truth)]):
        calibration = AnatomicalCalibration(
            segments=tuple(segments),
            frames=np.array(frames),
            rotation=np.stack([truth[f"{s}_rotation"][frames] for s in segments], 1),
            origin=np.stack([truth[f"{s}_origin"][frames] / MM for s in segments], 1),
        )
        problems.append(
            MarkerProblem(
                trajectories=trajectories(labels, places, float(truth["rate"])),
                clusters=clusters,
                calibration=calibration,
                joints=joints,
            )
        )
    return problems[0], problems[1]


def farthest(truth: np.lib.npyio.NpzFile) -> int:
    """The frame farthest from the first one in knee flexion."""
    thigh, shank = truth["thigh_rotation"], truth["shank_rotation"]
    known = np.isfinite(thigh).all((1, 2)) & np.isfinite(shank).all((1, 2))
    flexion = np.full(len(thigh), np.nan)
    flexion[known] = np.unwrap(
        Rotation.from_matrix(np.swapaxes(thigh[known], 1, 2) @ shank[known]).as_euler("ZXY")[:, 0]
    )
    return int(np.nanargmax(np.abs(flexion - flexion[0])))


def write_bones(motion: BoneMotion, path: Path) -> None:
    arrays = {}
    for index, name in enumerate(motion.segments):
        arrays[f"{name}_rotation"] = motion.rotation[:, index]
        arrays[f"{name}_origin"] = motion.origin[:, index] * MM
        if np.isfinite(motion.covariance[:, index]).any():
            arrays[f"{name}_rotation_sd"] = motion.rotation_sd[:, index]
            arrays[f"{name}_origin_sd"] = motion.origin_sd[:, index] * MM
    np.savez(path, **arrays)


def score(motion: BoneMotion, shared: Path, truth: Path) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "bones.npz"
        write_bones(motion, result)
        command = [sys.executable, str(shared / "score" / "bones.py"), str(result), str(truth)]
        return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


@dataclass(frozen=True, kw_only=True)
class Row:
    """What one method reached in one trial."""

    method: str
    postures: int
    thigh: float
    shank: float
    knee: tuple[float, float, float]
    against: float
    """The knee's root mean square against the rigid fit with one posture, less one."""
    held: float
    seen: float
    frames: int
    seconds: float

    @property
    def together(self) -> float:
        """Root mean square of the three angles."""
        return rms(list(self.knee))

    @property
    def angles(self) -> str:
        """The knee's angles in a cell."""
        return " ".join(f"{v:.1f}" for v in self.knee)

    @property
    def line(self) -> str:
        """The row of one trial's table."""
        return (
            f"| {self.method} | {self.postures} | {self.thigh:.1f} / {self.shank:.1f} | {self.angles} | "
            f"{self.together:.2f} | {100 * self.against:+.0f} % | {self.held:.2f} | {self.seen:.2f} | "
            f"{self.seconds:.2f} |"
        )


HEAD = """
### {}

| method | postures | thigh, shank | flexion, adduction, rotation | together | against rigid, 1 | 95 % hold | seen | s |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |"""


def rows_of(shared: Path, name: str, methods: list[str]) -> list[Row]:
    """Run the methods on one trial, printing as they end."""
    folder = shared / "data" / "markers" / "sta"
    truth = folder / f"{name}.npz"
    print(HEAD.format(name), flush=True)
    problems = read_trial(folder, name)
    first = score(METHODS["rigid"].run(problems[0]), shared, truth)["knee_rms_deg"]
    baseline, rows = rms(first), list[Row]()
    for entry in choose_methods(methods):
        for problem in problems:
            if entry.missing_requirement(problem):
                continue
            started = time.perf_counter()
            motion = entry.run(problem)
            seconds = time.perf_counter() - started
            rows.append(row(entry.name, problem, score(motion, shared, truth), baseline, seconds))
            print(rows[-1].line, flush=True)
    return rows


def row(name: str, problem: MarkerProblem, figures: dict, baseline: float, seconds: float) -> Row:
    segments = [figures["thigh"], figures["shank"]]
    knee = tuple(figures["knee_rms_deg"])
    return Row(
        method=name, postures=problem.calibration.postures, thigh=segments[0]["turn_rms_deg"],
        shank=segments[1]["turn_rms_deg"], knee=knee,
        against=rms(list(knee)) / baseline - 1,
        held=float(np.mean([s.get("covered_95", np.nan) for s in segments])),
        seen=min(s["seen"] for s in segments), frames=len(problem.trajectories), seconds=seconds,
    )  # fmt: skip


def first_stride_as_exercise(shared: Path, name: str = "lmam_treadmill_walking") -> None:
    """Learn skin motion from a trial's first stride with its true bones; print the others beside the rigid fit."""
    folder = shared / "data" / "markers" / "sta"
    truth = np.load(folder / f"{name}.npz")
    whole, _ = read_trial(folder, name)
    end, count = int(truth["event_heel_strike"][1]), len(whole.trajectories)
    exercise, activity = stretch(whole, truth, 0, end, list(range(end))), stretch(whole, truth, end, count, [end])
    with tempfile.TemporaryDirectory() as scratch:
        rest = Path(scratch) / "truth.npz"
        np.savez(rest, **{key: truth[key][end:] for key in truth if key.endswith(("_rotation", "_origin"))})
        for method in ("rigid", "artefact"):
            figures = score(METHODS[method].run(replace(activity, exercise=exercise)), shared, rest)
            print(method, f"{rms(figures['knee_rms_deg']):.2f}", figures)


def stretch(
    problem: MarkerProblem, truth: np.lib.npyio.NpzFile, first: int, end: int, known: list[int]
) -> MarkerProblem:
    """Cut frames out of a trial, its bones known in some of them (counted in the whole trial)."""
    trial, segments = problem.trajectories, problem.calibration.segments
    calibration = AnatomicalCalibration(
        segments=segments,
        frames=np.array(known) - first,
        rotation=np.stack([truth[f"{s}_rotation"][known] for s in segments], 1),
        origin=np.stack([truth[f"{s}_origin"][known] / MM for s in segments], 1),
    )
    points = trajectories(trial.labels, trial.points[first:end], trial.rate)
    return replace(problem, trajectories=points, calibration=calibration)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def print_together(trials: dict[str, list[Row]]) -> None:
    """Print one line a method over all trials: turns, the knee's angles and these together; means over the trials."""
    names = " | ".join(trials)
    print(f"\n### All trials\n\n| method | postures | {names} | mean against rigid, 1 | worst | 95 % hold |")
    print("| --- " * (5 + len(trials)) + "|")
    for lines in zip(*trials.values(), strict=True):
        cells = " | ".join(f"{r.thigh:.1f} / {r.shank:.1f}; {r.angles}; {r.together:.2f}" for r in lines)
        against = 100 * np.array([r.against for r in lines])
        frames = np.array([r.frames for r in lines])
        held = np.array([r.held for r in lines]) @ frames / frames.sum()
        print(
            f"| {lines[0].method} | {lines[0].postures} | {cells} | {against.mean():+.0f} % | {against.max():+.0f} % | "
            f"{held:.2f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("shared", type=Path)
    parser.add_argument("--methods", nargs="*", default=["all"])
    parser.add_argument("--trials", nargs="*")
    parser.add_argument("--exercise", action="store_true")
    given = parser.parse_args()
    if given.exercise:
        first_stride_as_exercise(given.shared)
        return
    names = given.trials or sorted(path.stem for path in (given.shared / "data" / "markers" / "sta").glob("*.c3d"))
    print_together({name: rows_of(given.shared, name, given.methods) for name in names})


if __name__ == "__main__":
    main()
