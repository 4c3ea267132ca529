"""Every method from skin markers to bones on the real trials with true bones, beside the rigid fit.

    python bench/markers_trials.py SHARED [--methods NAME ...] [--trials NAME ...]

The fair protocol: the bones are known in the first frame alone, or in that frame and the one farthest from it in knee
flexion. Prints a table a trial: degrees RMS of thigh and shank (turn) and of the knee's three angles, their root mean
square, that against the rigid fit with one posture, and the share of true errors that 1.96 stated standard deviations
hold; at the end each method's mean over the trials. The data: Cereatti et al. 2017, J Biomech,
doi 10.1016/j.jbiomech.2017.02.004. Figures are those of score/bones.py.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import ezc3d
import numpy as np
from scipy.spatial.transform import Rotation

from marey.markers.bone_motion import BoneMotion
from marey.markers.clusters import AnatomicalCalibration, Cluster
from marey.markers.methods import METHODS, choose_methods
from marey.markers.problem import MarkerProblem
from marey.markers.trajectories import trajectories

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


def row(name: str, postures: int, figures: dict, baseline: float, seconds: float) -> tuple[str, float, float]:
    """One line of the table, the knee's root mean square against the rigid fit, and the share held."""
    knee = figures["knee_rms_deg"]
    together = float(np.sqrt(np.mean(np.square(knee))))
    segments = [figures[s] for s in ("thigh", "shank")]
    held = float(np.mean([s.get("covered_95", np.nan) for s in segments]))
    seen = min(s["seen"] for s in segments)
    turn = " / ".join(f"{s['turn_rms_deg']:.1f}" for s in segments)
    angles = " ".join(f"{v:.1f}" for v in knee)
    against = together / baseline - 1
    line = (
        f"| {name} | {postures} | {turn} | {angles} | {together:.2f} | {100 * against:+.0f} % | {held:.2f} | {seen:.2f}"
    )
    return f"{line} | {seconds:.2f} |", against, held


HEAD = """
### {}

| method | postures | thigh, shank | flexion, adduction, rotation | together | against rigid, 1 | 95 % hold | seen | s |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |"""


def run_trial(shared: Path, name: str, methods: list[str], summary: dict) -> None:
    folder = shared / "data" / "markers" / "sta"
    print(HEAD.format(name), flush=True)
    problems = read_trial(folder, name)
    first = score(METHODS["rigid"].load()(problems[0]), shared, folder / f"{name}.npz")["knee_rms_deg"]
    baseline = float(np.sqrt(np.mean(np.square(first))))
    for entry in choose_methods(methods):
        for problem in problems:
            lacks, postures = entry.lacks(problem), problem.calibration.postures
            if lacks:
                continue
            started = time.perf_counter()
            motion = entry.load()(problem)
            seconds = time.perf_counter() - started
            figures = score(motion, shared, folder / f"{name}.npz")
            line, against, held = row(entry.name, postures, figures, baseline, seconds)
            summary.setdefault((entry.name, postures), []).append((against, held, len(motion)))
            print(line, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("shared", type=Path)
    parser.add_argument("--methods", nargs="*", default=["all"])
    parser.add_argument("--trials", nargs="*")
    given = parser.parse_args()
    folder = given.shared / "data" / "markers" / "sta"
    summary: dict[tuple[str, int], list[tuple[float, float, int]]] = {}
    for name in given.trials or sorted(path.stem for path in folder.glob("*.c3d")):
        run_trial(given.shared, name, given.methods, summary)
    print("\n### Over the trials\n\n| method | postures | mean against rigid, 1 | worst | 95 % hold, all frames |")
    print("| --- | --- | --- | --- | --- |")
    for (name, postures), values in summary.items():
        against, held, frames = np.array(values).T
        mean, worst = 100 * against.mean(), 100 * against.max()
        print(f"| {name} | {postures} | {mean:+.0f} % | {worst:+.0f} % | {held @ frames / frames.sum():.2f} |")


if __name__ == "__main__":
    main()
