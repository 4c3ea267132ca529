"""Registry of the methods from markers to bones: names, one-line summaries, and requirements."""

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import cast

from marey.errors import MareyError, SettingProblem
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.problem import MarkerProblem, Method
from marey.markers.preprocessing.preparation import prepare_problem


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodEntry:
    """One method, imported on first use."""

    name: str
    """Value of `--method`."""
    function: str
    """`room.module:function` within `marey.markers`."""
    summary: str
    """One-line summary."""
    postures: int = 1
    """Number of postures that the anatomical calibration must contain."""
    joints: bool = False
    """True if the method needs a joint between two segments."""
    exercise: bool = False
    """True if the method needs a second trial from which it learns the skin motion."""

    def load(self) -> Method:
        """Import the method."""
        module, function = self.function.split(":")
        return cast(Method, getattr(import_module(f"marey.markers.{module}"), function))

    def run(self, problem: MarkerProblem) -> BoneMotion:
        """Run the method on the usable part of a problem.

        Returns:
            The motion of all segments; NaN, with a note, for segments that no method could estimate.

        Raises:
            MareyError: The usable part of the problem missing_requirement something that the method requires.
        """
        ready = prepare_problem(problem)
        if ready.problem is None:
            return ready.with_all_segments(None)
        missing = self.missing_requirement(ready.problem)
        if missing:
            raise MareyError(" ".join([f"The method {self.name} {missing}.", *ready.notes]))
        return ready.with_all_segments(self.load()(ready.problem))

    def missing_requirement(self, problem: MarkerProblem) -> str:
        """Return the requirement of the method that a problem does not meet; empty if it meets all."""
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
            summary="markers' paths on the bone in a chosen functional form, with the bone's motion (Alexander 2001)",
        ),
        MethodEntry(
            name="homogeneous", function="methods.homogeneous:homogeneous",
            summary="each cluster as a few basis shapes in rigid motion (Alexander 2003)",
        ),
        MethodEntry(
            name="calibration", function="methods.multiple_calibration:multiple_calibration", postures=2,
            summary="markers' positions interpolated between known postures by the joint's rotation (Cappello 1997)",
        ),
        MethodEntry(
            name="artefact", function="methods.artefact_assessment:artefact_assessment", exercise=True,
            summary="skin motion learned from an exercise by a joint's rotation, then removed (Lucchetti 1998)",
        ),
        MethodEntry(
            name="skin", function="methods.estimator:skin_and_joints",
            summary="rigid clusters, soft joint constraints and a statistical model of the skin's motion, combined",
        ),
        MethodEntry(
            name="global", function="methods.global_optimisation:global_ball", joints=True,
            summary="all bones at once, ball joints or as specified, joint positions estimated (Lu and O'Connor 1999)",
        ),
        MethodEntry(
            name="global_hinge", function="methods.global_optimisation:global_hinge", joints=True,
            summary="the same with knees and elbows as hinges",
        ),
        MethodEntry(
            name="global_soft", function="methods.global_optimisation:global_soft", joints=True,
            summary="the same with six degrees of freedom in every joint, its centre constrained to 5 mm",
        ),
    )
}  # fmt: skip
"""All methods by name."""

DEFAULT_METHOD = "skin"
"""The default method, which has the smallest errors of all on trials with known bones (docs/accuracy/markers.md)."""


def choose_methods(names: Iterable[str]) -> tuple[MethodEntry, ...]:
    """Return the methods with these names; `all` selects every method.

    Raises:
        SettingProblem: A name is unknown.
    """
    names = list(names)
    unknown = [name for name in names if name not in METHODS and name != "all"]
    if unknown:
        raise SettingProblem(f"There is no method {', '.join(unknown)}. Available methods: {', '.join(METHODS)}, all.")
    chosen = METHODS if "all" in names else dict.fromkeys(names)
    return tuple(METHODS[name] for name in chosen)
