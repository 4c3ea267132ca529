"""Joints in the XML of OpenSim's models, each as a chain of turns and shifts."""

from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from marey.body.articulation.coordinate_functions import PiecewisePolynomial, constant, linear, scaled
from marey.body.articulation.jointed_body import JointTwist, ModelBody, ModelCoordinate
from marey.errors import FileProblem
from marey.geometry.rigid import RigidTransform
from marey.io.opensim.osim_functions import function_in, numbers, text, truth

KINDS = {
    "WeldJoint": "",
    "PinJoint": "rz",
    "SliderJoint": "tx",
    "UniversalJoint": "rx ry",
    "BallJoint": "rx ry rz",
    "GimbalJoint": "rx ry rz",
    "PlanarJoint": "rz tx ty",
    "FreeJoint": "rx ry rz tx ty tz",
}
"""The coordinates of each kind of joint in the file's order: turn or shift, and the axis. Shifts are along the axes of
the parent's frame, turns follow each other."""

_AXES = tuple(f"{kind}{i}" for kind in ("rotation", "translation") for i in (1, 2, 3))


@dataclass(frozen=True, eq=False, kw_only=True)
class Joint:
    """A joint between two bodies; None is the ground."""

    name: str
    parent: str | None
    before: RigidTransform
    """Parent body from the joint's frame on it."""
    motions: tuple[JointTwist, ...]
    child: str | None
    after: RigidTransform
    """Child body from the joint's frame on it."""
    coordinates: tuple[ModelCoordinate, ...]

    def reversed(self) -> "Joint":
        """Give the same joint from the child to the parent."""
        undone = tuple(replace(m, function=scaled(m.function, -1.0)) for m in self.motions[::-1])
        return replace(self, parent=self.child, before=self.after, motions=undone, child=self.parent, after=self.before)

    def as_body(self) -> ModelBody:
        """Give the child, hanging on the parent."""
        return ModelBody(
            name=str(self.child), parent=self.parent, joint=self.name, before=self.before, motions=self.motions,
            after=self.after.inverse(),
        )  # fmt: skip


def read_joint(
    path: Path | str, element: Element, coordinates: list[Element],
    parent: str | None, before: RigidTransform, child: str | None, after: RigidTransform,
) -> Joint:  # fmt: skip
    """Read a joint of any kind.

    Args:
        path: The file, for messages.
        element: The joint.
        coordinates: Its coordinates, in the file's order.
        parent: The body on the parent's side.
        before: Parent body from the joint's frame.
        child: The body on the child's side.
        after: Child body from the joint's frame.

    Raises:
        FileProblem: Joints of this kind are not read, or something in it is not.
    """
    name = element.get("name", "")
    if element.tag == "CustomJoint":
        motions = _custom(path, element, name)
        angles = {m.coordinate for m in motions if m.turns and m.function.coefficients.shape[-1] == 2}
        read = [coordinate_of(path, c, rotational=_is_angle(c, angles)) for c in coordinates]
    elif element.tag in KINDS:
        steps = KINDS[element.tag].split()
        given = [*coordinates, *[Element("Coordinate") for _ in steps[len(coordinates) :]]]
        read = [coordinate_of(path, c, rotational=s[0] == "r") for c, s in zip(given, steps, strict=False)]
        read = [replace(c, name=c.name or f"{name}_coord_{i}") for i, c in enumerate(read)]
        motions = tuple(
            JointTwist(
                turns=step[0] == "r", axis=np.eye(3)["xyz".index(step[1])], coordinate=c.name, function=linear(1.0)
            )
            for step, c in sorted(zip(steps, read, strict=True), key=lambda pair: pair[0][0] == "r")
        )
    else:
        raise FileProblem(
            path, f"has the joint {name!r}, a {element.tag}, which is not read",
            f"Read are CustomJoint, {', '.join(KINDS)}.",
        )  # fmt: skip
    return Joint(
        name=name, parent=parent, before=before, motions=motions, child=child, after=after, coordinates=tuple(read)
    )


def _is_angle(coordinate: Element, angles: set[str | None]) -> bool:
    """Tell whether a coordinate of a custom joint is an angle: as the file says, or where a turn is linear in it."""
    said = text(coordinate, "motion_type").lower()
    return said == "rotational" if said in ("rotational", "translational") else coordinate.get("name") in angles


def _custom(path: Path | str, element: Element, joint: str) -> tuple[JointTwist, ...]:
    """Read the axes of a CustomJoint: the shifts come first, then the turns, each about the axis the last has moved."""
    given = element.findall("SpatialTransform/TransformAxis")
    named = {axis.get("name", ""): axis for axis in given}
    if len(given) != 6 and (len(named) != len(given) or not set(named) <= set(_AXES)):
        raise FileProblem(
            path, f"has {len(given)} axes in the SpatialTransform of the joint {joint!r}",
            f"Write six: {', '.join(_AXES)}.",
        )  # fmt: skip
    axes = given if len(given) == 6 else [named.get(name, Element("TransformAxis")) for name in _AXES]
    motions = [_axis(path, axis, joint, turns=i < 3) for i, axis in enumerate(axes)]
    moving = [m for m in motions[3:] + motions[:3] if m.coordinate is not None or m.function.at(0.0)[0] != 0.0]
    return tuple(moving)


def _axis(path: Path | str, element: Element, joint: str, *, turns: bool) -> JointTwist:
    """Read one axis of a CustomJoint."""
    where = f"{element.get('name', 'an axis')} of the joint {joint!r}"
    names = text(element, "coordinates").split()
    if len(names) > 1:
        raise FileProblem(
            path, f"moves {where} by {len(names)} coordinates at once, which is not read", "Use one coordinate an axis."
        )
    function = function_in(path, element, where) or (linear(1.0) if names else constant(0.0))
    axis = numbers(path, element, "axis", where, np.array([1.0, 0.0, 0.0]))
    length = float(np.linalg.norm(axis))
    if length == 0:
        raise FileProblem(path, f"has no direction in <axis> of {where}", "Write a vector.")
    return JointTwist(
        turns=turns, axis=axis / length, coordinate=names[0] if names else None, function=_settled(function, names)
    )


def _settled(function: PiecewisePolynomial, names: list[str]) -> PiecewisePolynomial:
    """Without a coordinate a function has the value that it has at zero."""
    return function if names else constant(float(function.at(0.0)[0]))


def coordinate_of(path: Path | str, element: Element, *, rotational: bool) -> ModelCoordinate:
    """Read a coordinate: default, limits that are kept, whether it is locked."""
    name = element.get("name", "")
    where = f"the coordinate {name!r}"
    if truth(element, "prescribed"):
        raise FileProblem(path, f"has {where} prescribed, which is not read", "Set <prescribed> to false, or lock it.")
    lower, upper = -np.inf, np.inf
    if truth(element, "clamped"):
        lower, upper = numbers(path, element, "range", where, np.array([-np.inf, np.inf]))
    if lower > upper:
        raise FileProblem(path, f"has the range {lower} to {upper} for {where}", "Write the lower limit first.")
    return ModelCoordinate(
        name=name, rotational=rotational, default=float(numbers(path, element, "default_value", where, np.zeros(1))[0]),
        lower=float(lower), upper=float(upper), locked=truth(element, "locked"),
    )  # fmt: skip
