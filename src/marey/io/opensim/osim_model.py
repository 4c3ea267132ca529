"""Reading an OpenSim model (.osim): bodies, joints, coordinates, couplings and markers."""

from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element

import numpy as np

from marey.body.articulation.coordinate_functions import linear, scaled
from marey.body.articulation.jointed_body import Coupling, JointedBody, ModelBody, ModelMarker
from marey.errors import FileProblem, MareyError
from marey.geometry.rigid import RigidTransform
from marey.geometry.rotations import about
from marey.io.documents import read_xml
from marey.io.opensim.osim_functions import function_in, numbers, text, truth
from marey.io.opensim.osim_joints import OpenSimJoint, read_joint

_FIRST_WITH_FRAMES = 30500
"""First version of the file format with a separate set of joints, which refer to frames."""
_ZERO = np.zeros(3)
"""Default of positions [m] and orientations [rad] that are missing in the file."""


def read_osim_model(path: Path | str) -> JointedBody:
    """Read the kinematics of an OpenSim model, in its own axes and units (metres, radians).

    Files before version 4.0 (joints inside of bodies) and from 4.0 on (joints in a set, offset frames) are supported.
    Muscles, contacts, masses and geometry are ignored.

    Args:
        path: The `.osim` file.

    Returns:
        The model.

    Raises:
        FileProblem: The file is not an OpenSim model, or has an unsupported joint, function or constraint.
    """
    return model_in(path, read_osim(path))


def read_osim(path: Path | str) -> Element:
    """Read the XML of an OpenSim model.

    Args:
        path: The `.osim` file.

    Returns:
        The root of the document.

    Raises:
        FileProblem: The file is not an OpenSim model.
    """
    root = read_xml(path, "Give an OpenSim model.")
    if model_element(root) is None:
        wrong = f"is not an OpenSim model: it has <{root.tag}> and no <Model>"
        raise FileProblem(path, wrong, "Give an .osim file.")
    return root


def model_element(root: Element) -> Element | None:
    """Return the `<Model>` of a document; None if it has none.

    Args:
        root: The root of the document.
    """
    return root if root.tag == "Model" else root.find("Model")


def with_joints_in_a_set(root: Element) -> bool:
    """Return whether a document has joints in a set, which refer to frames, or, before version 4.0, inside of bodies.

    Args:
        root: The root of the document.
    """
    version = root.get("Version", "40000")
    return version.isdigit() and int(version) >= _FIRST_WITH_FRAMES


def model_in(path: Path | str, root: Element) -> JointedBody:
    """Return the kinematics of the OpenSim model in a document; see `read_osim_model`.

    Args:
        path: The file, for error messages.
        root: The root of the document.

    Raises:
        FileProblem: The model has an unsupported joint, function or constraint, or none.
    """
    model = model_element(root)
    assert model is not None
    new = with_joints_in_a_set(root)
    frames = ModelFrames(path)
    bodies = elements_of(model, "BodySet", "Body")
    names = [b.get("name", "") for b in bodies if b.get("name") != "ground"]
    if not names:
        raise FileProblem(path, "has no bodies", "Give a model with a BodySet.")
    frames.add_bodies(bodies, names)
    if new:
        joints = _joints_of_set(path, model, frames)
    else:
        joints = [joint for b in bodies if (joint := _joint_of_body(path, b, frames)) is not None]
    coordinates = tuple(c for joint in joints for c in joint.coordinates)
    try:
        return JointedBody(
            name=model.get("name", ""), bodies=_tree(path, names, joints), coordinates=coordinates,
            couplings=_couplings(path, model), markers=_markers(path, model, frames),
        )  # fmt: skip
    except FileProblem:
        raise
    except MareyError as error:
        raise FileProblem(path, f"is inconsistent ({str(error).rstrip('.')})", "Correct the model.") from error


def elements_of(model: Element, holder: str, *kinds: str) -> list[Element]:
    """Return the elements of a set, of the given kinds or, without any, of all kinds.

    Args:
        model: The `<Model>`.
        holder: Name of the set.
        *kinds: Names of the elements.
    """
    objects = model.find(f"{holder}/objects")
    return [] if objects is None else [e for e in objects if not kinds or e.tag in kinds]


def _transform(path: Path | str, element: Element, place: str, turn: str, where: str) -> RigidTransform:
    """Read a translation [m] and an orientation: rotations about X, then the moved Y, then the moved Z [rad]."""
    angles = numbers(path, element, turn, where, _ZERO)
    rotation = np.linalg.multi_dot([about(axis, angle) for axis, angle in zip(np.eye(3), angles, strict=True)])
    return RigidTransform(rotation, numbers(path, element, place, where, _ZERO))


@dataclass
class ModelFrames:
    """All frames by their path in the model: the body to which each is fixed, and its pose in that body."""

    path: Path | str
    """The file, for error messages."""
    known: dict[str, tuple[str | None, RigidTransform]] = field(default_factory=dict)
    """Maps the path of a frame to its body (None for the ground) and the transform body from frame."""

    def add_bodies(self, bodies: list[Element], names: list[str]) -> None:
        """Add the ground, the bodies, and the offset frames that the bodies contain."""
        self.known["/ground"] = (None, RigidTransform.identity())
        for name in names:
            self.known[f"/bodyset/{name}"] = (name, RigidTransform.identity())
        for body in bodies:
            held = body.find("components")
            self.add_offsets([] if held is None else list(held), f"/bodyset/{body.get('name')}")

    def add_offsets(self, elements: list[Element], owner: str) -> None:
        """Add the offset frames among the elements of an owner; a frame may be attached to another of them."""
        waiting = [e for e in elements if e.tag == "PhysicalOffsetFrame"]
        while waiting:
            left = []
            for frame in waiting:
                own = f"{owner}/{frame.get('name')}"
                parent = self.find(socket_of(frame, "parent"), own)
                if parent is None:
                    left.append(frame)
                    continue
                body, place = parent
                inside = _transform(self.path, frame, "translation", "orientation", f"the frame {own}")
                self.known[own] = (body, place @ inside)
            if len(left) == len(waiting):
                bad = left[0]
                raise FileProblem(
                    self.path, f"has a frame {bad.get('name')!r} on {socket_of(bad, 'parent')!r}, which does not exist",
                    "Name a body, the ground or a frame of the model.",
                )  # fmt: skip
            waiting = left

    def find(self, wanted: str, owner: str) -> tuple[str | None, RigidTransform] | None:
        """Find a frame by the path in a socket of an owner: absolute, relative, or only the last part.

        Args:
            wanted: The path in the socket.
            owner: The path of the element with the socket.

        Returns:
            The body (None for the ground) and the transform body from frame; None if there is no such frame.
        """
        for base in (owner, str(PurePosixPath(owner).parent), "", "/bodyset"):
            candidate = _normal(wanted if wanted.startswith("/") else f"{base}/{wanted}")
            if candidate in self.known:
                return self.known[candidate]
        last = PurePosixPath(wanted).name
        same = [place for key, place in self.known.items() if PurePosixPath(key).name == last]
        return same[0] if last not in ("", "..") and len(same) == 1 else None

    def get(self, wanted: str, owner: str) -> tuple[str | None, RigidTransform]:
        """Return a frame, or raise a `FileProblem` if it does not exist."""
        found = self.find(wanted, owner)
        if found is None:
            raise FileProblem(
                self.path, f"has no frame {wanted!r} for {owner}", "Name a body, the ground or a frame of the model."
            )
        return found


def _normal(path: str) -> str:
    """Resolve `.` and `..` in a path of the model."""
    parts: list[str] = []
    for part in path.split("/"):
        if part == "..":
            parts = parts[:-1]
        elif part not in ("", "."):
            parts.append(part)
    return "/" + "/".join(parts)


def socket_of(element: Element, name: str) -> str:
    """Return the path in a socket of an element; empty if it has none.

    Args:
        element: The element.
        name: Name of the socket.
    """
    for tag in (f"socket_{name}", f"socket_{name}_connectee_name"):
        if text(element, tag):
            return text(element, tag)
    return ""


def _joints_of_set(path: Path | str, model: Element, frames: ModelFrames) -> list[OpenSimJoint]:
    """Read the joints of a file from version 4.0 on."""
    joints = []
    for element in elements_of(model, "JointSet"):
        owner = f"/jointset/{element.get('name')}"
        held = element.find("frames")
        frames.add_offsets([] if held is None else list(held), owner)
        parent, before = frames.get(socket_of(element, "parent_frame"), owner)
        child, after = frames.get(socket_of(element, "child_frame"), owner)
        coordinates = element.findall("coordinates/Coordinate")
        joints.append(read_joint(path, element, coordinates, parent, before, child, after))
    return joints


def _joint_of_body(path: Path | str, body: Element, frames: ModelFrames) -> OpenSimJoint | None:
    """Read the joint inside a body of a file before version 4.0; None for the ground."""
    name = body.get("name", "")
    held = body.find("Joint")
    if held is None or not len(held):
        if name != "ground":
            raise FileProblem(path, f"has a body {name!r} without a joint", "Add the joint to its parent.")
        return None
    element = held[0]
    where = f"the joint {element.get('name')!r}"
    if truth(element, "reverse"):
        raise FileProblem(path, f"has {where} reversed, which is not supported", "Exchange its parent and child.")
    parent, _ = frames.get(text(element, "parent_body", "ground"), f"/bodyset/{name}")
    before = _transform(path, element, "location_in_parent", "orientation_in_parent", where)
    after = _transform(path, element, "location", "orientation", where)
    coordinates = element.findall("CoordinateSet/objects/Coordinate")
    return read_joint(path, element, coordinates, parent, before, name, after)


def _tree(path: Path | str, names: list[str], joints: list[OpenSimJoint]) -> tuple[ModelBody, ...]:
    """Return the bodies as a tree from the ground; a joint whose child is nearer to the ground is reversed."""
    reached: dict[str | None, None] = {None: None}
    bodies: list[ModelBody] = []
    waiting = list(joints)
    while waiting:
        ready = [joint for joint in waiting if (joint.parent in reached) or (joint.child in reached)]
        if not ready:
            break
        joint = ready[0]
        waiting.remove(joint)
        if joint.parent in reached and joint.child in reached:
            raise FileProblem(
                path, f"has a loop of bodies, closed by the joint {joint.name!r}, which is not supported",
                "Remove one joint of the loop.",
            )  # fmt: skip
        body = joint.as_body() if joint.parent in reached else joint.reversed().as_body()
        bodies.append(body)
        reached[body.name] = None
    lost = [name for name in names if name not in reached]
    if lost:
        wrong = f"has bodies that are not connected to the ground: {', '.join(lost)}"
        raise FileProblem(path, wrong, "Add a joint for each.")
    return tuple(bodies)


def _couplings(path: Path | str, model: Element) -> tuple[Coupling, ...]:
    """Read the constraints that couple coordinates."""
    couplings = []
    for element in elements_of(model, "ConstraintSet"):
        name = element.get("name", "")
        if truth(element, "isDisabled") or not truth(element, "isEnforced", True):
            continue
        if element.tag != "CoordinateCouplerConstraint":
            raise FileProblem(
                path, f"has the constraint {name!r}, a {element.tag}, which is not supported",
                "Remove or disable it; only CoordinateCouplerConstraint is supported.",
            )  # fmt: skip
        where = f"the constraint {name!r}"
        independent = text(element, "independent_coordinate_names").split()
        function = function_in(path, element, where, "coupled_coordinates_function") or linear(1.0)
        function = scaled(function, float(numbers(path, element, "scale_factor", where, np.ones(1))[0]))
        if len(independent) != 1:
            raise FileProblem(
                path,
                f"has {len(independent)} independent coordinates in {where}, which is not supported",
                "Name one independent coordinate.",
            )
        couplings.append(
            Coupling(
                dependent=text(element, "dependent_coordinate_name"), independent=independent[0], function=function
            )
        )
    return tuple(couplings)


def _markers(path: Path | str, model: Element, frames: ModelFrames) -> tuple[ModelMarker, ...]:
    """Read the markers with label, body and position in the body."""
    markers = []
    for element in elements_of(model, "MarkerSet", "Marker"):
        label = element.get("name", "")
        on = socket_of(element, "parent_frame") or text(element, "body")
        body, place = frames.get(on, f"/markerset/{label}")
        location = numbers(path, element, "location", f"the marker {label!r}", _ZERO)
        markers.append(ModelMarker(label=label, body=body, place=place.apply(location)))
    return tuple(markers)
