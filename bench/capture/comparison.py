"""Captured takes beside a second measuring system: its clock and laboratory are estimated, elbows and knees compared.

The second system is made of the take's true joint centres: at 50 Hz, in axes of its own, on a clock of its own, with
0.5 mm of noise, as TRC and MOT. `marey compare` compares the capture with both files, as section 3 of [Rosenhahn2006]
compares two systems.
"""

import argparse
from pathlib import Path

import numpy as np

from bench.common import program
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.geometry.rigid import RigidTransform
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.io.opensim.trc import PointPaths, write_trc
from marey.motion.comparison import MotionComparison
from marey.motion.recording import interpolated
from marey.pipelines.compare import compare

BENCH = Bench(
    measures="Estimated clock and laboratory of a second, made system, and the agreement of joint angles with it.",
    sources=("src/marey/motion", "src/marey/fit", "src/marey/observations", "src/marey/pipelines/compare.py",
             "src/marey/pipelines/same_names.py"),
    minutes=2,
)
RATE, SHIFT, NOISE_M = 50.0, 0.2345, 5e-4
OTHER_FROM_OWN = RigidTransform.from_vector(np.radians([2.0, -3.0, 130.0]), np.array([1.5, -0.8, 0.1]))
HINGES = {"knee": ("hip", "knee", "ankle"), "elbow": ("shoulder", "elbow", "wrist")}


def write_other(truth: Path, out: Path) -> tuple[Path, Path]:
    """Write the truth as another system's TRC and MOT."""
    with np.load(truth) as file:
        names, joints = [str(n) for n in file["joint_names"]], file["joints"]
        rate, empty = float(file["rate"]), int(file["empty"])
    time = (empty + np.arange(len(joints))) / rate
    own = np.arange(time[0], time[-1], 1 / RATE)
    points = interpolated(time, joints, own)
    noise = NOISE_M * np.random.default_rng(0).normal(size=points.shape)
    sides = {"l_": "left_", "r_": "right_"}
    written = {sides[name[:2]] + name[2:]: k for k, name in enumerate(names) if name[:2] in sides}
    moved = OTHER_FROM_OWN.apply(points + noise)[:, list(written.values())]
    write_trc(out / "other.trc", PointPaths(names=tuple(written), time=own + SHIFT, rate=RATE, points=moved))
    angles = {
        f"{side}{hinge}_flexion": flexion(*(points[:, written[f"{side}{name}"]] for name in three))
        for side in sides.values()
        for hinge, three in HINGES.items()
    }
    values = np.degrees(np.stack(list(angles.values()), 1))
    write_table(
        out / "other.mot", TimeSeriesTable(name="other", columns=tuple(angles), time=own + SHIFT, values=values)
    )
    return out / "other.trc", out / "other.mot"


def flexion(near: np.ndarray, middle: np.ndarray, far: np.ndarray) -> np.ndarray:
    """The angle by which a limb is bent at its middle joint (F,) [rad]."""
    a, b = middle - near, far - middle
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1))


def laboratories(result: MotionComparison) -> tuple[float | None, ...]:
    """Turn [deg] and shift [mm] of the estimated laboratory from the true one, each with its stated deviation."""
    found = result.alignment
    if not result.first.point_names:
        return None, None, None, None, None
    off = found.first_from_second @ OTHER_FROM_OWN
    turn, move = np.degrees(np.linalg.norm(off.rotation_vector)), 1e3 * np.linalg.norm(off.translation)
    stated = np.degrees(np.linalg.norm(found.turn_sd)), 1e3 * np.linalg.norm(found.translation_sd)
    return turn, stated[0], move, stated[1], 1e3 * found.residual_m


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help="rendered takes of data/people; walk and reach without any")


def run(run: Run) -> None:
    """Compare the captured takes with the made system."""
    where = run.table(
        "Clock and laboratory", ("take", "from"),
        Column("shift off by", "ms", 2), Column("stated sd", "ms", 2), Column("turned by", "deg", 2),
        Column("stated sd", "deg", 2), Column("moved by", "mm", 1), Column("stated sd", "mm", 1),
        Column("common points apart", "mm", 1),
    )  # fmt: skip
    angles = run.table(
        "Angles", ("take", "from", "angle"),
        Column("RMS", "deg", 2), Column("bias", "deg", 2), Column("lower limit", "deg", 2),
        Column("upper limit", "deg", 2), Column("correlation", "", 3),
    )  # fmt: skip
    for take in run.arguments.takes or ("walk", "reach"):
        trial, results = program.take(run, take)
        out = run.out / "comparison" / take
        out.mkdir(parents=True, exist_ok=True)
        for path in write_other(program.truth_of(trial), out):
            comparison = compare(results, path)
            comparison.save(out / f"compared_{path.suffix[1:]}")
            result = comparison.data
            found, kind = result.alignment, "points" if path.suffix == ".trc" else "elbows and knees alone"
            where.row((take, kind), 1e3 * (found.shift_s - SHIFT), 1e3 * found.shift_sd_s, *laboratories(result))
            for row in result.agreements:
                if row.kind == "angle":
                    values = np.degrees([row.rms, row.bias, *row.limits])
                    angles.row((take, kind, row.name), *values, row.correlation)
