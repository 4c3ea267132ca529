"""Global optimisation on real trials with true bones, the knee with one to six degrees of freedom.

The protocol and the columns are those of `markers/trials`. 1 is a hinge, 2 two axes, 3 a ball, 4 and 5 a ball whose
centre glides, 6 free, all held exactly; `6, 5 mm` is free with its centre held by 5 mm. The joint's place is
estimated with the motion.
"""

import argparse
from collections.abc import Callable

from bench.declaration import Bench
from bench.markers.trials import compare_methods, sta_trials
from bench.recording import Run
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.problem import MarkerProblem
from marey.markers.methods.chain import ChainJoint
from marey.markers.methods.global_optimisation import optimise_chain
from marey.markers.preprocessing.preparation import prepare_problem

BENCH = Bench(
    measures=(
        "Bones by global optimisation with knees of one to six degrees of freedom, against true bones of real trials."
    ),
    sources=("src/marey/markers", "src/marey/motion", "src/marey/geometry"),
    minutes=3,
)
KNEES: dict[str, tuple[int, float | None]] = {str(n): (n, None) for n in range(1, 7)} | {"6, 5 mm": (6, 0.005)}
"""Degrees of freedom, and how softly the centre is held [m]."""


def with_knee(degrees: int, sd_m: float | None) -> Callable[[MarkerProblem], BoneMotion]:
    """Global optimisation with a knee of some degrees of freedom."""

    def estimate(problem: MarkerProblem) -> BoneMotion:
        ready = prepare_problem(problem)
        if ready.problem is None:
            return ready.with_all_segments(None)
        ends = ready.problem.joints
        joints = [ChainJoint(parent=p, child=c, degrees_of_freedom=degrees, sd_m=sd_m) for p, c in ends]
        return ready.with_all_segments(optimise_chain(ready.problem, joints).bones)

    return estimate


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--trials", nargs="*", help="of data/markers/sta; all without any")


def run(run: Run) -> None:
    """Estimate bones, and score them."""
    methods = [(name, with_knee(*knee)) for name, knee in KNEES.items()]
    compare_methods(
        run, "Knees in global optimisation", "degrees of freedom", methods, sta_trials(run, run.arguments.trials)
    )
