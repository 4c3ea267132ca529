"""Every method from skin markers to bones on real trials with true bones, beside the rigid fit.

The bones are known in the first frame alone (one posture), or in that frame and the one farthest from it in knee
flexion (two). `--exercise`: artefact assessment on the treadmill alone, skin learned from the first stride with the
true bones, the other strides as the activity. The data: Cereatti et al. 2017, J Biomech, doi
10.1016/j.jbiomech.2017.02.004.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import ezc3d
import numpy as np
from scipy.spatial.transform import Rotation

from bench.common import program
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.trajectories import trajectories
from marey.markers.methods.methods import METHODS, choose_methods

BENCH = Bench(
    measures="Bones from skin markers by every method, against true bones of real trials.",
    sources=("src/marey/markers", "src/marey/motion", "src/marey/geometry"),
    minutes=3,
)
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


def score(run: Run, motion: BoneMotion, truth: Path) -> dict:
    """The scores of estimated bones, by score/bones.py."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "bones.npz"
        write_bones(motion, result)
        return program.score(run, "bones.py", result, truth)


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


NOTE = (
    "Each cell: root mean square turn error of thigh / shank; of the knee's flexion, adduction and rotation; of "
    "these three "
    "together (degrees). *Against rigid*: the last number against the rigid fit with one posture, mean of the "
    "trials and the "
    "worst of them. *Hold*: share of the true errors within 1.96 stated standard deviations, over all frames. "
    "*Seen*: smallest "
    "share of frames with a result."
)
Method = tuple[str, Callable[[MarkerProblem], BoneMotion | None]]
"""A name, and the estimate; None where the method cannot use the trial."""


def sta_trials(run: Run, names: Sequence[str] | None) -> list[str]:
    """The chosen trials of data/markers/sta, or all."""
    return list(names or sorted(path.stem for path in (run.shared / "data" / "markers" / "sta").glob("*.c3d")))


def compare_methods(run: Run, title: str, label: str, methods: Sequence[Method], names: Sequence[str]) -> None:
    """Run all methods on all trials, and fill one table with one row per method and number of postures."""
    trials = {name: rows_of(run, name, methods) for name in names}
    columns = [Column(name) for name in trials]
    summary = (
        Column("mean against rigid", "%", 0),
        Column("worst", "%", 0),
        Column("95 % hold", "", 2),
        Column("seen", "", 2),
    )
    table = run.table(title, (label, "postures"), *columns, *summary, note=NOTE)
    for lines in zip(*trials.values(), strict=True):
        cells = [f"{r.thigh:.1f} / {r.shank:.1f}; {r.angles}; {r.together:.2f}" for r in lines]
        against = 100 * np.array([r.against for r in lines])
        frames = np.array([r.frames for r in lines])
        held = np.array([r.held for r in lines]) @ frames / frames.sum()
        seen = min(r.seen for r in lines)
        table.row((lines[0].method, str(lines[0].postures)), *cells, against.mean(), against.max(), held, seen)


def rows_of(run: Run, name: str, methods: Sequence[Method]) -> list[Row]:
    """Run the methods on one trial."""
    folder = run.shared / "data" / "markers" / "sta"
    truth = folder / f"{name}.npz"
    problems = read_trial(folder, name)
    baseline, rows = rms(score(run, METHODS["rigid"].run(problems[0]), truth)["knee_rms_deg"]), list[Row]()
    for method, estimate in methods:
        for problem in problems:
            started = time.perf_counter()
            motion = estimate(problem)
            if motion is not None:
                seconds = time.perf_counter() - started
                rows.append(row(method, problem, score(run, motion, truth), baseline, seconds))
                run.report(f"{name}: {method}, {rows[-1].postures}: {rows[-1].together:.2f} degrees, {seconds:.2f} s")
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


def first_stride_as_exercise(run: Run, name: str = "lmam_treadmill_walking") -> None:
    """Learn skin motion from a trial's first stride with its true bones; the other strides beside the rigid fit."""
    folder = run.shared / "data" / "markers" / "sta"
    truth = np.load(folder / f"{name}.npz")
    whole, _ = read_trial(folder, name)
    end, count = int(truth["event_heel_strike"][1]), len(whole.trajectories)
    exercise, activity = stretch(whole, truth, 0, end, list(range(end))), stretch(whole, truth, end, count, [end])
    table = run.table(
        f"{name}: skin learned from the first stride",
        "method",
        *(
            Column(f"{segment} {what}", unit, 1)
            for segment in ("thigh", "shank")
            for what, unit in (("turn", "deg"), ("origin", "mm"))
        ),
        Column("knee's angles together", "deg", 2),
    )
    with tempfile.TemporaryDirectory() as scratch:
        rest = Path(scratch) / "truth.npz"
        np.savez(rest, **{key: truth[key][end:] for key in truth if key.endswith(("_rotation", "_origin"))})
        for method in ("rigid", "artefact"):
            figures = score(run, METHODS[method].run(replace(activity, exercise=exercise)), rest)
            errors = [
                figures[segment][key] for segment in ("thigh", "shank") for key in ("turn_rms_deg", "origin_rms_mm")
            ]
            table.row(method, *errors, rms(figures["knee_rms_deg"]))


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


def rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--methods", nargs="*", default=["all"])
    parser.add_argument("--trials", nargs="*", help="of data/markers/sta; all without any")
    parser.add_argument("--exercise", action="store_true")


def run(run: Run) -> None:
    """Estimate bones, and score them."""
    given = run.arguments
    if given.exercise:
        first_stride_as_exercise(run)
        return
    methods = [
        (each.name, lambda problem, e=each: None if e.missing_requirement(problem) else e.run(problem))
        for each in choose_methods(given.methods)
    ]
    compare_methods(run, "Methods on real trials", "method", methods, sta_trials(run, given.trials))
