"""Captured takes beside a second measuring system: its clock and laboratory found again, its elbows and knees compared.

`python bench/comparison.py RESULTS TRUTH.npz OUT` takes the results of `marey capture` on a rendered take, and
writes the take's true joint centres as another laboratory would give them: at 50 Hz, in axes of its own, on a clock of
its own, with 0.5 mm of noise, as `other.trc` and `other.mot`. It then runs `marey compare` on both pairs and prints how
far the estimates lie from the truth, as section 3 of [Rosenhahn2006] compares two systems.
"""

import sys
from pathlib import Path

import numpy as np

from marey.geometry.rigid import RigidTransform
from marey.io.opensim.mot_sto import Table, write_table
from marey.io.opensim.trc import PointPaths, write_trc
from marey.motion.comparison import MotionComparison
from marey.motion.recording import interpolated
from marey.pipelines.compare import CompareOptions, compare
from marey.pipelines.progress import Progress

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
    write_table(out / "other.mot", Table(name="other", columns=tuple(angles), time=own + SHIFT, values=values))
    return out / "other.trc", out / "other.mot"


def flexion(near: np.ndarray, middle: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Give the angle by which a limb is bent at its middle joint (F,) [rad]."""
    a, b = middle - near, far - middle
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1))


def tell(what: str, result: MotionComparison) -> None:
    found = result.alignment
    print(f"{what}: shift off by {1e3 * (found.shift_s - SHIFT):+.2f} ms, stated sd {1e3 * found.shift_sd_s:.2f} ms")
    if result.first.point_names:
        off = found.first_from_second @ OTHER_FROM_OWN
        turn, move = np.degrees(np.linalg.norm(off.rotation_vector)), 1e3 * np.linalg.norm(off.translation)
        stated = np.degrees(np.linalg.norm(found.turn_sd)), 1e3 * np.linalg.norm(found.translation_sd)
        print(f"  laboratories off by {turn:.2f} degrees (sd {stated[0]:.2f}) and {move:.1f} mm (sd {stated[1]:.1f})")
        print(f"  points in common {1e3 * found.residual_m:.1f} mm apart")
    for row in result.agreements:
        if row.kind == "angle":
            low, high = np.degrees(row.limits)
            print(
                f"  {row.name}: RMS {np.degrees(row.rms):.2f} degrees, bias {np.degrees(row.bias):+.2f}, limits "
                f"{low:+.2f} to {high:+.2f}, correlation {row.correlation:.3f}"
            )


def main(results: Path, truth: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    for path in write_other(truth, out):
        options = CompareOptions(out=out / f"compared_{path.suffix[1:]}")
        tell(path.name, compare(results, path, options, Progress(quiet=True))[1])


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
