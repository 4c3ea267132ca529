"""Scaling the bodies of an OpenSim model in its XML: joints, masses, markers, paths of muscles, wrapping, geometry."""

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.jointed_kinematics import place
from marey.errors import FileProblem
from marey.io.opensim.osim_functions import function_in, numbers, text
from marey.io.opensim.osim_joints import KINDS
from marey.io.opensim.osim_model import (
    ModelFrames,
    elements_of,
    model_element,
    model_in,
    socket_of,
    with_joints_in_a_set,
)

ONE = np.ones(3)
"""Scale factors of the ground."""
_POINTS = ("PathPoint", "ConditionalPathPoint", "MovingPathPoint")
"""Points of the path of a muscle or ligament."""
_WITH_LENGTHS = {"optimal_fiber_length", "tendon_slack_length", "resting_length"}
"""Lengths of a muscle or ligament [m] that keep their share of the length of the path."""
_VECTORS = ("dimensions", "radii", "half_lengths")
"""Sizes along the axes of the body, of drawn geometry and wrapping ellipsoids."""
_SIZES = ("radius", "length", "inner_radius", "outer_radius", "half_height")
"""Sizes of wrapping objects and drawn geometry without a direction [m]."""
_SCALARS = {"Constant": "value", "SimmSpline": "y", "NaturalCubicSpline": "y", "PiecewiseLinearFunction": "y",
            "LinearFunction": "coefficients", "PolynomialFunction": "coefficients",
            "MultiplierFunction": "scale"}  # fmt: skip
"""Element of each kind of function whose numbers are proportional to its value."""


def scale_osim(
    path: Path | str, root: Element, factors: Mapping[str, Floats], masses: Mapping[str, float] | None = None
) -> JointedBody:
    """Scale the bodies of a model, in place.

    Joints, centres of mass, markers, points of muscles, wrapping objects and geometry move with their bodies. A body
    keeps the shape of its distribution of mass: its inertia is that of the scaled shape with the new mass. Fibres and
    tendons of muscles, and resting lengths of ligaments, keep their share of the length of the path in the default
    posture; unlike in OpenSim, that is the straight path through its points, without wrapping objects.

    Args:
        path: The file, for error messages.
        root: The root of the document.
        factors: Maps a body to its three scale factors along the axes of the body; others remain as they are.
        masses: Maps a body to its new mass [kg]; others keep theirs.

    Returns:
        The kinematics of the scaled model.

    Raises:
        FileProblem: The model has an unsupported joint, function or constraint, or an invalid number.
    """
    before = model_in(path, root)
    old = _path_lengths(path, root, before)
    _Scaling(path, root, before, factors).apply()
    if masses is not None:
        _set_masses(path, root, masses)
    after = model_in(path, root)
    for holder, length in _path_lengths(path, root, after).items():
        if old[holder] > 0:
            for tag in _WITH_LENGTHS:
                _multiply(path, holder, tag, length / old[holder])
    return after


def body_masses(path: Path | str, root: Element) -> dict[str, float]:
    """Return the mass of each body of a model [kg].

    Args:
        path: The file, for error messages.
        root: The root of the document.
    """
    zero = np.zeros(1)
    return {
        name: float(numbers(path, body, "mass", f"the body {name!r}", zero)[0]) for name, body in _bodies(root).items()
    }


def _model(root: Element) -> Element:
    model = model_element(root)
    assert model is not None  # `read_osim` requires it
    return model


def _bodies(root: Element) -> dict[str, Element]:
    """Return the bodies by name, without the ground."""
    found = {body.get("name", ""): body for body in elements_of(_model(root), "BodySet", "Body")}
    return {name: body for name, body in found.items() if name != "ground"}


def _write(element: Element, tag: str, values: Floats) -> None:
    child = element.find(tag)
    assert child is not None
    child.text = " ".join(f"{v + 0.0:.15g}" for v in np.ravel(values))


def _multiply(path: Path | str, element: Element, tag: str, factors: Floats | float) -> None:
    """Multiply the numbers of a child, if the element has it."""
    if text(element, tag):
        values = numbers(path, element, tag, f"<{element.tag}> {element.get('name', '')!r}")
        _write(element, tag, values * factors)


def _size(factors: Floats) -> float:
    """Return the factor of a size without a direction: the geometric mean."""
    return float(np.prod(factors) ** (1 / 3))


class _Scaling:
    """The scaling of one document, which is changed in place."""

    def __init__(self, path: Path | str, root: Element, model: JointedBody, factors: Mapping[str, Floats]) -> None:
        self.path, self.root, self.model, self.factors = path, root, model, factors
        self.frames = _all_frames(path, root, model)

    def of(self, body: str | None) -> Floats:
        """Return the factors of a body; those of the ground are one."""
        return np.asarray(self.factors.get(body or "", ONE), float)

    def apply(self) -> None:
        for name, body in _bodies(self.root).items():
            self._body(name, body)
        for element in elements_of(_model(self.root), "JointSet"):
            self._joint_of_set(element)
        for element in _model(self.root).iter():
            if element.tag in ("PathPoint", "ConditionalPathPoint", "Marker"):
                _multiply(self.path, element, "location", self.of(self._body_of(element)))
            elif element.tag == "MovingPathPoint":
                for axis, factor in zip("xyz", self.of(self._body_of(element)), strict=True):
                    self._function(element, float(factor), f"{axis}_location")
            elif element.tag.startswith("Contact") and text(element, "location"):
                factors = self.of(self._body_of(element))
                _multiply(self.path, element, "location", factors)
                _multiply(self.path, element, "radius", _size(factors))
        for element in elements_of(_model(self.root), "ConstraintSet", "CoordinateCouplerConstraint"):
            self._coupling(element)

    def _body_of(self, element: Element) -> str | None:
        """Return the body to which a point is fixed; None for the ground."""
        return _body_of(self.frames, element)

    def _body(self, name: str, body: Element) -> None:
        """Scale the centre of mass, the inertia, and everything that the element of a body contains."""
        factors = self.of(name)
        _multiply(self.path, body, "mass_center", factors)
        _scale_inertia(self.path, body, factors)
        for child in body:
            if child.tag == "Joint":
                self._joint_of_body(name, child)
            elif child.tag != "components":
                self._shapes(child, factors)
        self._offsets(body.find("components"), f"/bodyset/{name}")

    def _shapes(self, holder: Element, factors: Floats) -> None:
        """Scale drawn geometry and wrapping objects; the drawn axes of a frame stay as they are."""
        drawn_as_a_whole = holder.tag == "VisibleObject" and text(holder, "scale_factors")
        for element in [holder] if drawn_as_a_whole else holder.iter():
            if element.tag == "FrameGeometry":
                continue
            if text(element, "scale_factors"):
                _multiply(self.path, element, "scale_factors", factors)
                continue
            for tag in _VECTORS:
                _multiply(self.path, element, tag, factors)
            for tag in _SIZES:
                _multiply(self.path, element, tag, _size(factors))
            if element.tag.startswith("Wrap"):
                _multiply(self.path, element, "translation", factors)

    def _offsets(self, holder: Element | None, owner: str) -> None:
        """Scale the offset frames among the children of an element."""
        for frame in [] if holder is None else holder.findall("PhysicalOffsetFrame"):
            body, _ = self.frames.get(socket_of(frame, "parent"), f"{owner}/{frame.get('name')}")
            _multiply(self.path, frame, "translation", self.of(body))
            for child in frame:
                self._shapes(child, self.of(body))

    def _joint_of_set(self, element: Element) -> None:
        """Scale a joint of a file from version 4.0 on."""
        owner = f"/jointset/{element.get('name')}"
        parent, _ = self.frames.get(socket_of(element, "parent_frame"), owner)
        self._offsets(element.find("frames"), owner)
        self._translations(element, self.of(parent))

    def _joint_of_body(self, name: str, holder: Element) -> None:
        """Scale the joint inside of a body of a file before version 4.0."""
        for element in holder:
            parent = self.of(text(element, "parent_body", "ground"))
            _multiply(self.path, element, "location_in_parent", parent)
            _multiply(self.path, element, "location", self.of(name))
            self._translations(element, parent)

    def _translations(self, joint: Element, factors: Floats) -> None:
        """Scale the translations of a joint that are functions of an angle, or fixed."""
        if joint.tag in KINDS:
            return
        for axis in joint.findall("SpatialTransform/TransformAxis"):
            name = text(axis, "coordinates")
            own = name and not self.model.coordinates[self.model.coordinate(name)].rotational
            if axis.get("name", "").startswith("translation") and not own:
                direction = numbers(self.path, axis, "axis", f"the joint {joint.get('name')!r}", np.array([1.0, 0, 0]))
                along = np.linalg.norm(direction * factors) / np.linalg.norm(direction)
                self._function(axis, float(along), "function")

    def _function(self, element: Element, factor: float, wrapper: str) -> None:
        """Multiply the values of the function in an element."""
        inside = element.find(wrapper)
        held = list(inside) if inside is not None else [child for child in element if child.get("name") == wrapper]
        if inside is not None and inside.tag in _SCALARS:
            held = [inside]
        held = held or [child for child in element if child.tag in _SCALARS]
        if not held:
            return
        if held[0].tag not in _SCALARS:
            where = f"<{element.tag}> {element.get('name', '')!r}"
            raise FileProblem(
                self.path, f"has a {held[0].tag} in {where}, which cannot be scaled",
                f"The supported functions are {', '.join(_SCALARS)}.",
            )  # fmt: skip
        _multiply(self.path, held[0], _SCALARS[held[0].tag], factor)

    def _coupling(self, element: Element) -> None:
        """Scale the values of a translation that follows another coordinate."""
        name = text(element, "dependent_coordinate_name")
        if self.model.coordinates[self.model.coordinate(name)].rotational:
            return
        moved = [body for body in self.model.bodies if name in {m.coordinate for m in body.motions}]
        if moved:
            self._function(element, _size(self.of(moved[0].parent)), "coupled_coordinates_function")


def _all_frames(path: Path | str, root: Element, model: JointedBody) -> ModelFrames:
    """Return the frames of bodies and joints."""
    frames = ModelFrames(path)
    frames.add_bodies(elements_of(_model(root), "BodySet", "Body"), list(model.body_names))
    if with_joints_in_a_set(root):
        for element in elements_of(_model(root), "JointSet"):
            held = element.find("frames")
            frames.add_offsets([] if held is None else list(held), f"/jointset/{element.get('name')}")
    return frames


def _body_of(frames: ModelFrames, element: Element) -> str | None:
    """Return the body to which a point is fixed; None for the ground."""
    on = socket_of(element, "parent_frame") or socket_of(element, "frame")
    on = on or text(element, "body") or text(element, "body_name", "ground")
    return frames.get(on, f"/{element.tag}/{element.get('name', '')}")[0]


def _scale_inertia(path: Path | str, body: Element, factors: Floats) -> None:
    """Scale the inertia of a body without changing its mass.

    With the second moments of the mass J = tr(I) / 2 - I, those of the scaled shape are S J S.
    """
    inertia = _inertia(path, body)
    if inertia is None:
        return
    moments = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    scaled = factors[:, None] * moments * factors
    _write_inertia(body, np.trace(scaled) * np.eye(3) - scaled)


_PLACES = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
"""Places in the matrix of the six numbers of an inertia, in the order of the file."""


def _inertia(path: Path | str, body: Element) -> Floats | None:
    """Return the inertia about the centre of mass (3, 3) [kg m2]; None if the body has none."""
    where = f"the body {body.get('name')!r}"
    if text(body, "inertia"):
        six = numbers(path, body, "inertia", where, np.zeros(6))
    elif text(body, "inertia_xx"):
        six = np.array([numbers(path, body, f"inertia_{at}", where, np.zeros(1))[0] for at in _PLACES])
    else:
        return None
    matrix = np.zeros((3, 3))
    for value, (i, j) in zip(six, _PLACES.values(), strict=True):
        matrix[i, j] = matrix[j, i] = value
    return matrix


def _write_inertia(body: Element, matrix: Floats) -> None:
    if text(body, "inertia"):
        _write(body, "inertia", np.array([matrix[at] for at in _PLACES.values()]))
        return
    for name, at in _PLACES.items():
        if body.find(f"inertia_{name}") is not None:
            _write(body, f"inertia_{name}", np.array(matrix[at]))


def _set_masses(path: Path | str, root: Element, masses: Mapping[str, float]) -> None:
    """Set masses, and multiply the inertias accordingly."""
    old = body_masses(path, root)
    for name, body in _bodies(root).items():
        if name in masses and body.find("mass") is not None:
            _write(body, "mass", np.array(masses[name]))
            inertia = _inertia(path, body)
            if inertia is not None and old[name] > 0:
                _write_inertia(body, inertia * masses[name] / old[name])


def _path_lengths(path: Path | str, root: Element, model: JointedBody) -> dict[Element, float]:
    """Return the straight length of each path in the default posture [m], by the element that has it."""
    frames, placed = _all_frames(path, root, model), place(model, model.defaults)
    index = {name: k for k, name in enumerate(model.body_names)}

    def at(element: Element) -> Floats:
        body = _body_of(frames, element)
        spot = _location(path, element, model)
        return spot if body is None else placed.rotation[index[body]] @ spot + placed.origin[index[body]]

    lengths = {}
    for holder in _model(root).iter():
        if not any(holder.find(tag) is not None for tag in _WITH_LENGTHS):
            continue
        points = [at(element) for element in holder.iter() if element.tag in _POINTS and _active(path, element, model)]
        steps = np.diff(np.reshape(points, (-1, 3)), axis=0)
        lengths[holder] = float(np.linalg.norm(steps, axis=1).sum())
    return lengths


def _location(path: Path | str, element: Element, model: JointedBody) -> Floats:
    """Return the position of a point on its body in the default posture [m]."""
    where = f"the point {element.get('name')!r}"
    if element.tag != "MovingPathPoint":
        return numbers(path, element, "location", where, np.zeros(3))
    return np.array([_moving(path, element, model, axis, where) for axis in "xyz"])


def _moving(path: Path | str, element: Element, model: JointedBody, axis: str, where: str) -> float:
    function = function_in(path, element, where, f"{axis}_location")
    return 0.0 if function is None else float(function.at(_default(element, model, f"{axis}_coordinate"))[0])


def _default(element: Element, model: JointedBody, tag: str) -> float:
    """Return the default of the coordinate on which a point depends [rad or m]."""
    name = (socket_of(element, tag) or text(element, tag)).rpartition("/")[2]
    return float(model.defaults[model.coordinate(name)]) if name in model.coordinate_names else 0.0


def _active(path: Path | str, element: Element, model: JointedBody) -> bool:
    """Return whether a point is part of the path in the default posture."""
    if element.tag != "ConditionalPathPoint":
        return True
    everywhere = np.array([-np.inf, np.inf])
    low, high = numbers(path, element, "range", f"the point {element.get('name')!r}", everywhere)
    return bool(low <= _default(element, model, "coordinate") <= high)
