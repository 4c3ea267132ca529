"""Global optimisation on the real trials with true bones, the knee with one to six degrees of freedom.

    python bench/joint_freedom.py SHARED [--trials NAME ...]

The protocol and the columns are those of bench/markers_trials.py; a knee of n degrees is `ChainJoint`'s, held fast, and
`6, 5 mm` is one of six degrees whose centre is held softly. At the end one line a knee over all trials.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from markers_trials import HEAD, Row, print_together, read_trial, row, score

from marey.markers.chain import ChainJoint
from marey.markers.global_optimisation import optimise_chain
from marey.markers.rigid_fit import rigid

KNEES: dict[str, tuple[int, float | None]] = {str(n): (n, None) for n in range(1, 7)} | {"6, 5 mm": (6, 0.005)}
"""Degrees of freedom, and how softly the centre is held [m]."""


def rows_of(shared: Path, name: str) -> list[Row]:
    """Take the knee of one trial for each of KNEES, printing as they end."""
    truth = shared / "data" / "markers" / "sta" / f"{name}.npz"
    problems = read_trial(truth.parent, name)
    first = score(rigid(problems[0]), shared, truth)["knee_rms_deg"]
    baseline, rows = float(np.sqrt(np.mean(np.square(first)))), []
    print(HEAD.format(name), flush=True)
    for knee, (degrees, sd_m) in KNEES.items():
        for problem in problems:
            joints = [ChainJoint(parent=p, child=c, degrees_of_freedom=degrees, sd_m=sd_m) for p, c in problem.joints]
            began = time.perf_counter()
            bones = optimise_chain(problem, joints).bones
            seconds = time.perf_counter() - began
            rows.append(row(knee, problem, score(bones, shared, truth), baseline, seconds))
            print(rows[-1].line, flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--trials", nargs="*")
    asked = parser.parse_args()
    names = asked.trials or sorted(path.stem for path in (asked.shared / "data" / "markers" / "sta").glob("*.c3d"))
    print_together({name: rows_of(asked.shared, name) for name in names})


if __name__ == "__main__":
    main()
