"""Reading joints from the XML of OpenSim's models, as chains of rotations and translations."""

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
"""Coordinates of each kind of joint in the order of the file: rotation (r) or translation (t), and axis. Translations
are along the axes of the parent's frame; each rotation is about the axis as moved by the previous ones."""

_AXES = tuple(f"{kind}{i}" for kind in ("rotation", "translation") for i in (1, 2, 3))
"""Names of the six axes in the SpatialTransform of a CustomJoint, in their order."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OpenSimJoint:
    """A joint between two bodies of an OpenSim model; None is the ground."""

    name: str
    parent: str | None
    """Parent body."""
    before: RigidTransform
    """Parent body from the frame of the joint on it."""
    motions: tuple[JointTwist, ...]
    """Rotations and translations from the parent's to the child's frame."""
    child: str | None
    """Child body."""
    after: RigidTransform
    """Child body from the frame of the joint on it."""
    coordinates: tuple[ModelCoordinate, ...]
    """Coordinates of the joint, in the order of the file."""

    def reversed(self) -> "OpenSimJoint":
        """Return the same joint from the child to the parent."""
        undone = tuple(replace(m, function=scaled(m.function, -1.0)) for m in self.motions[::-1])
        return replace(self, parent=self.child, before=self.after, motions=undone, child=self.parent, after=self.before)

    def as_body(self) -> ModelBody:
        """Return the child as a body that is attached to the parent."""
        return ModelBody(
            name=str(self.child), parent=self.parent, joint=self.name, before=self.before, motions=self.motions,
            after=self.after.inverse(),
        )  # fmt: skip


def read_joint(
    path: Path | str, element: Element, coordinates: list[Element],
    parent: str | None, before: RigidTransform, child: str | None, after: RigidTransform,
) -> OpenSimJoint:  # fmt: skip
    """Read a joint of any supported kind.

    Args:
        path: The file, for error messages.
        element: The joint.
        coordinates: The coordinates of the joint, in the order of the file.
        parent: The parent body; None is the ground.
        before: Parent body from the frame of the joint.
        child: The child body; None is the ground.
        after: Child body from the frame of the joint.

    Returns:
        The joint.

    Raises:
        FileProblem: The kind of the joint, or something in it, is not supported.
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
            path, f"has the joint {name!r}, a {element.tag}, which is not supported",
            f"The supported joints are CustomJoint, {', '.join(KINDS)}.",
        )  # fmt: skip
    return OpenSimJoint(
        name=name, parent=parent, before=before, motions=motions, child=child, after=after, coordinates=tuple(read)
    )


def _is_angle(coordinate: Element, angles: set[str | None]) -> bool:
    """Return whether a coordinate of a CustomJoint is an angle: as stated, or if a rotation is linear in it."""
    stated = text(coordinate, "motion_type").lower()
    return stated == "rotational" if stated in ("rotational", "translational") else coordinate.get("name") in angles


def _custom(path: Path | str, element: Element, joint: str) -> tuple[JointTwist, ...]:
    """Read the axes of a CustomJoint: first the translations, then the rotations, each about the axis moved so far."""
    given = element.findall("SpatialTransform/TransformAxis")
    named = {axis.get("name", ""): axis for axis in given}
    if len(given) != 6 and (len(named) != len(given) or not set(named) <= set(_AXES)):
        raise FileProblem(
            path, f"has {len(given)} axes in the SpatialTransform of the joint {joint!r}",
            f"There should be six: {', '.join(_AXES)}.",
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
        wrong = f"has {len(names)} coordinates for {where}, which is not supported"
        raise FileProblem(path, wrong, "Use one coordinate per axis.")
    function = function_in(path, element, where) or (linear(1.0) if names else constant(0.0))
    axis = numbers(path, element, "axis", where, np.array([1.0, 0.0, 0.0]))
    length = float(np.linalg.norm(axis))
    if length == 0:
        raise FileProblem(path, f"has a zero vector in <axis> of {where}", "Write a vector that is not zero.")
    return JointTwist(
        turns=turns, axis=axis / length, coordinate=names[0] if names else None, function=_settled(function, names)
    )


def _settled(function: PiecewisePolynomial, names: list[str]) -> PiecewisePolynomial:
    """Return the function, or, for an axis without a coordinate, its value at zero as a constant."""
    return function if names else constant(float(function.at(0.0)[0]))


def coordinate_of(path: Path | str, element: Element, *, rotational: bool) -> ModelCoordinate:
    """Read a coordinate: default value, limits (only if clamped), and whether it is locked.

    Args:
        path: The file, for error messages.
        element: The coordinate.
        rotational: Whether the coordinate is an angle.

    Raises:
        FileProblem: The coordinate is prescribed, or a number is invalid.
    """
    name = element.get("name", "")
    where = f"the coordinate {name!r}"
    if truth(element, "prescribed"):
        remedy = "Set <prescribed> to false, or lock the coordinate."
        raise FileProblem(path, f"has {where} prescribed, which is not supported", remedy)
    lower, upper = -np.inf, np.inf
    if truth(element, "clamped"):
        lower, upper = numbers(path, element, "range", where, np.array([-np.inf, np.inf]))
    if lower > upper:
        raise FileProblem(path, f"has the range {lower} to {upper} for {where}", "The lower limit should be first.")
    return ModelCoordinate(
        name=name, rotational=rotational, default=float(numbers(path, element, "default_value", where, np.zeros(1))[0]),
        lower=float(lower), upper=float(upper), locked=truth(element, "locked"),
    )  # fmt: skip
