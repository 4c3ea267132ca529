"""The methods from markers to bones by name: what each does in a line, and what it needs."""

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import cast

from marey.errors import MareyError, SettingProblem
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.problem import MarkerProblem, Method
from marey.markers.preprocessing.preparation import prepared


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodEntry:
    """One method, loaded when it is asked for."""

    name: str
    """As `--method` takes it."""
    function: str
    """`room.module:function` within `marey.markers`."""
    summary: str
    """What it does, in a line."""
    postures: int = 1
    """In how many postures the anatomical calibration must be known."""
    joints: bool = False
    """True for one that needs a joint between two segments."""
    exercise: bool = False
    """True for one that needs a second trial to learn from."""

    def load(self) -> Method:
        """Import the method."""
        module, function = self.function.split(":")
        return cast(Method, getattr(import_module(f"marey.markers.{module}"), function))

    def run(self, problem: MarkerProblem) -> BoneMotion:
        """Run the method on what it can use of a problem; NaN, and said, for segments that no method could answer.

        Raises:
            MareyError: The problem, or what is left of it, lacks something that the method needs.
        """
        ready = prepared(problem)
        if ready.problem is None:
            return ready.whole(None)
        lacks = self.lacks(ready.problem)
        if lacks:
            raise MareyError(" ".join([f"The method {self.name} {lacks}.", *ready.notes]))
        return ready.whole(self.load()(ready.problem))

    def lacks(self, problem: MarkerProblem) -> str:
        """Say what this method needs and the problem does not have; nothing where it has all."""
        if problem.calibration.postures < self.postures:
            return f"needs an anatomical calibration in {self.postures} postures"
        if self.joints and not problem.joints:
            return "needs a joint between two segments"
        if self.exercise and problem.exercise is None:
            return "needs an exercise trial"
        return ""


METHODS: dict[str, MethodEntry] = {
    entry.name: entry
    for entry in (
        MethodEntry(
            name="rigid", function="data.rigid_fit:rigid",
            summary="each cluster as a rigid body, least squares (Spoor and Veldpaus 1980)",
        ),
        MethodEntry(
            name="pct", function="methods.point_cluster:point_cluster",
            summary="centre of mass and principal axes of each cluster, unit masses (Andriacchi 1998)",
        ),
        MethodEntry(
            name="pct_masses", function="methods.point_cluster:point_cluster_masses",
            summary="the same, masses chosen so that the eigenvalues of inertia stay constant (Andriacchi 1998)",
        ),
        MethodEntry(
            name="interval", function="methods.interval_deformation:interval",
            summary="markers' paths on the bone of a chosen form, with the bone's motion (Alexander 2001)",
        ),
        MethodEntry(
            name="homogeneous", function="methods.homogeneous:homogeneous",
            summary="each cluster as a few basis shapes in rigid motion (Alexander 2003)",
        ),
        MethodEntry(
            name="calibration", function="methods.multiple_calibration:multiple_calibration", postures=2,
            summary="markers' places interpolated between known postures by the joint's turn (Cappello 1997)",
        ),
        MethodEntry(
            name="artefact", function="methods.artefact_assessment:artefact_assessment", exercise=True,
            summary="skin motion learned from an exercise against a joint's turn, taken away (Lucchetti 1998)",
        ),
        MethodEntry(
            name="skin", function="methods.estimator:skin_and_joints",
            summary="rigid clusters, joints that give a little and a statistical model of the skin's motion, together",
        ),
        MethodEntry(
            name="global", function="methods.global_optimisation:global_ball", joints=True,
            summary="all bones at once, joints as balls or as said, their places estimated (Lu and O'Connor 1999)",
        ),
        MethodEntry(
            name="global_hinge", function="methods.global_optimisation:global_hinge", joints=True,
            summary="the same with knees and elbows as hinges",
        ),
        MethodEntry(
            name="global_soft", function="methods.global_optimisation:global_soft", joints=True,
            summary="the same with six degrees in every joint, its centre held to 5 mm",
        ),
    )
}  # fmt: skip

DEFAULT = "skin"
"""The method that is taken where nobody asks for another one: it measures best (docs/accuracy.md)."""


def choose_methods(names: Iterable[str]) -> tuple[MethodEntry, ...]:
    """Give the methods of these names, `all` being every one.

    Raises:
        SettingProblem: A name is unknown.
    """
    names = list(names)
    unknown = [name for name in names if name not in METHODS and name != "all"]
    if unknown:
        raise SettingProblem(f"There is no method {', '.join(unknown)}. There are: {', '.join(METHODS)}, all.")
    chosen = METHODS if "all" in names else dict.fromkeys(names)
    return tuple(METHODS[name] for name in chosen)
