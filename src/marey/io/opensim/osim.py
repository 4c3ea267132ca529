"""Writing the body as an OpenSim model with the coordinates of the skeleton."""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT, ROOT_AXES, ROOT_COORDINATES
from marey.body.articulation.surface import Body
from marey.body.people.mass import estimated_mass
from marey.errors import MareyError
from marey.io.atomic import replacing
from marey.io.axes import OPENSIM_FROM_WORLD, change_point_axes
from marey.motion.anatomical import euler_angles
from marey.motion.driving import GRAVITY

_MASS_SHARES = {
    ("head", "neck"): 0.0681,
    ("thorax", "left_clavicle", "right_clavicle"): 0.1571,
    ("abdomen",): 0.1549,
    ("pelvis",): 0.1182,
} | {
    tuple(f"{side}_{segment}" for segment in segments): share
    for side in ("left", "right")
    for segments, share in (
        (("upperarm",), 0.0263), (("forearm",), 0.0150), (("hand",), 0.00585),
        (("thigh",), 0.1447), (("shank",), 0.0457), (("foot", "toes"), 0.0133),
    )
}  # fmt: skip
"""Fraction of the body's mass by group of segments, mean of men and women ([deLeva1996] table 4)."""

NORMAL_95 = 1.959964
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""


def write_osim(path: Path | str, body: Body, *, mass_kg: float | None = None) -> None:
    """Write a body as an OpenSim model, version 4.0, with Y up; the default pose is the body at rest.

    Every segment is a body with its origin at its proximal joint centre and, at rest, the axes of the ground. Each
    joint is a CustomJoint with the coordinates of the skeleton in their order and about their axes, so that the same
    numbers (in degrees, the first three of the root in metres) give the same pose. Markers are at the joint centres;
    ellipsoids show the segments.

    Args:
        path: The file.
        body: The body at rest.
        mass_kg: Mass of the person, distributed by [deLeva1996]; None estimates it from the volume of the body, which
            the name of the model and `<credits>` state.

    Raises:
        MareyError: A joint has more than three axes, or linearly dependent ones, which OpenSim does not support.
    """
    document = Element("OpenSimDocument", Version="40000")
    model = SubElement(document, "Model", name="body" if mass_kg is not None else "body_with_estimated_mass")
    if mass_kg is None:
        mass_kg, sd = estimated_mass(body)
        SubElement(model, "credits").text = mass_note(mass_kg, sd)
    SubElement(model, "length_units").text = "meters"
    SubElement(model, "force_units").text = "N"
    SubElement(model, "gravity").text = f"0 {-GRAVITY} 0"
    SubElement(model, "Ground", name="ground")
    masses = _masses(body, mass_kg)
    bodies = SubElement(SubElement(model, "BodySet", name="bodyset"), "objects")
    joints = SubElement(SubElement(model, "JointSet", name="jointset"), "objects")
    for k, name in enumerate(body.skeleton.segment_names):
        bodies.append(_body(name, *_ellipsoid(body, k), masses[k]))
        joints.append(_joint(body, k))
    markers = SubElement(SubElement(model, "MarkerSet", name="markerset"), "objects")
    for segment in body.skeleton.segment_names:
        if segment in JOINT_OF_SEGMENT:
            marker = SubElement(markers, "Marker", name=JOINT_OF_SEGMENT[segment])
            SubElement(marker, "socket_parent_frame").text = f"/bodyset/{segment}"
            SubElement(marker, "location").text = "0 0 0"
            SubElement(marker, "fixed").text = "true"
    ElementTree.indent(document)
    with replacing(path) as temporary:
        ElementTree.ElementTree(document).write(temporary, encoding="UTF-8", xml_declaration=True)


def mass_note(mass_kg: float, sd: float) -> str:
    """Return the sentence that marks an estimated mass.

    Args:
        mass_kg: The mass [kg].
        sd: Its standard deviation [kg].
    """
    low, high = mass_kg - NORMAL_95 * sd, mass_kg + NORMAL_95 * sd
    return (
        f"The mass was not given: {mass_kg:.1f} kg (95 % interval {low:.0f} to {high:.0f} kg) is estimated from the "
        "volume of the body with its clothes."
    )


def _text(values: Floats) -> str:
    """Format numbers, separated by blanks."""
    return " ".join(f"{v + 0.0:.12g}" for v in np.ravel(values))


def _ellipsoid(body: Body, segment: int) -> tuple[Floats, Floats]:
    """Return mean (3,) [m] and covariance (3, 3) [m^2], in the file's axes, of the vertices bound to a segment."""
    carrier = np.take_along_axis(body.vertex_segments, np.argmax(body.vertex_weights, 1)[:, None], 1)[:, 0]
    own = body.vertices[carrier == segment] - body.joint_centres[segment]
    if len(own) < 4:
        return np.zeros(3), np.zeros((3, 3))
    own = change_point_axes(OPENSIM_FROM_WORLD, own)
    return own.mean(0), np.cov(own.T, bias=True)


def _masses(body: Body, mass_kg: float) -> Floats:
    """Return the masses of the segments (S,) [kg]: by table between groups, by volume of the ellipsoids within one."""
    names = body.skeleton.segment_names
    masses = np.zeros(len(names))
    for group, share in _MASS_SHARES.items():
        inside = [names.index(name) for name in group if name in names]
        volume = np.array([np.sqrt(max(np.linalg.det(_ellipsoid(body, k)[1]), 0.0)) for k in inside])
        if len(inside):
            masses[inside] = mass_kg * share * (volume / volume.sum() if volume.sum() > 0 else 1 / len(inside))
    return masses


def _body(name: str, centre: Floats, spread: Floats, mass: float) -> Element:
    """Return one body with mass, centre of mass and inertia of a homogeneous ellipsoid, and the ellipsoid itself."""
    element = Element("Body", name=name)
    # The covariance of an ellipsoid's surface has a third of its squared radii as eigenvalues.
    radii_squared, turn = np.linalg.eigh(3 * spread)
    if np.linalg.det(turn) < 0:
        turn = turn * [-1, 1, 1]
    if radii_squared[0] > 1e-8:
        frame = SubElement(SubElement(element, "components"), "PhysicalOffsetFrame", name=f"{name}_shape")
        drawing = SubElement(SubElement(frame, "attached_geometry"), "Ellipsoid", name=f"{name}_ellipsoid")
        SubElement(drawing, "socket_frame").text = ".."
        SubElement(SubElement(drawing, "Appearance"), "color").text = "0.8 0.7 0.6"
        SubElement(drawing, "radii").text = _text(np.sqrt(radii_squared))
        SubElement(frame, "socket_parent").text = ".."
        SubElement(frame, "translation").text = _text(centre)
        SubElement(frame, "orientation").text = _text(euler_angles(turn, "XYZ"))
    inside = spread * 3 / 5
    inertia = mass * (np.trace(inside) * np.eye(3) - inside)
    SubElement(element, "mass").text = _text(np.array(mass))
    SubElement(element, "mass_center").text = _text(centre)
    places = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    SubElement(element, "inertia").text = _text(np.array([inertia[place] for place in places]))
    return element


def _joint(body: Body, k: int) -> Element:
    """Return the joint between a segment and its parent, or, for the root, the ground."""
    skeleton = body.skeleton
    name, parent = skeleton.segment_names[k], int(skeleton.parents[k])
    own = [c for c in skeleton.coordinates if c.segment == name]
    turns = [(c.name, np.array(c.axis), (c.lower, c.upper)) for c in own]
    moves: list[tuple[str, Floats, tuple[float, float]]] = []
    offset = np.zeros(3)
    if parent < 0:
        around = [(n, np.array(a), (-np.inf, np.inf)) for n, a in zip(ROOT_COORDINATES[3:], ROOT_AXES, strict=True)]
        moves = [(n, axis, (-np.inf, np.inf)) for n, axis in zip(ROOT_COORDINATES[:3], np.eye(3), strict=True)]
        turns = around + turns
    else:
        offset = body.joint_centres[k] - body.joint_centres[parent]
    element = Element(
        "CustomJoint" if turns or moves else "WeldJoint", name=JOINT_OF_SEGMENT.get(name, f"{name}_joint")
    )
    above = "ground" if parent < 0 else skeleton.segment_names[parent]
    SubElement(element, "socket_parent_frame").text = f"{above}_offset"
    SubElement(element, "socket_child_frame").text = f"{name}_offset"
    if turns or moves:
        listed = SubElement(element, "coordinates")
        for coordinate, _, limits in turns + moves:
            listed.append(_coordinate(coordinate, limits, metres=coordinate in ROOT_COORDINATES[:3]))
    frames = SubElement(element, "frames")
    for frame, socket, place in (
        (above, "/ground" if parent < 0 else f"/bodyset/{above}", offset),
        (name, f"/bodyset/{name}", np.zeros(3)),
    ):
        offset_frame = SubElement(frames, "PhysicalOffsetFrame", name=f"{frame}_offset")
        SubElement(offset_frame, "socket_parent").text = socket
        SubElement(offset_frame, "translation").text = _text(change_point_axes(OPENSIM_FROM_WORLD, place))
        SubElement(offset_frame, "orientation").text = "0 0 0"
    if turns or moves:
        element.append(_spatial_transform(name, turns, moves))
    return element


def _coordinate(name: str, limits: tuple[float, float], *, metres: bool) -> Element:
    """Return one coordinate with its limits, in metres or radians."""
    element = Element("Coordinate", name=name)
    unlimited = 100.0 if metres else 4 * np.pi
    SubElement(element, "default_value").text = "0"
    SubElement(element, "range").text = _text(np.clip(limits, -unlimited, unlimited))
    SubElement(element, "clamped").text = "false"
    return element


def _spatial_transform(
    name: str,
    turns: list[tuple[str, Floats, tuple[float, float]]],
    moves: list[tuple[str, Floats, tuple[float, float]]],
) -> Element:
    """Return the six axes of a joint; OpenSim rotates about the first, then the moved second and third."""
    axes = np.array([axis for _, axis, _ in turns]).reshape(-1, 3)
    if len(turns) > 3 or np.linalg.matrix_rank(axes, tol=1e-6) < len(turns):
        raise MareyError(
            f"The joint of {name!r} cannot be written for OpenSim. It has {len(turns)} axes; there should be at most "
            "three, and linearly independent ones."
        )
    complete = [*axes, *np.linalg.svd(axes, full_matrices=True)[2][len(axes) :]]
    element = Element("SpatialTransform")
    for kind, used, all_axes in (("rotation", turns, complete), ("translation", moves, list(np.eye(3)))):
        for i in range(3):
            axis = SubElement(element, "TransformAxis", name=f"{kind}{i + 1}")
            SubElement(axis, "coordinates").text = used[i][0] if i < len(used) else ""
            SubElement(axis, "axis").text = _text(change_point_axes(OPENSIM_FROM_WORLD, all_axes[i]))
            if i < len(used):
                function = SubElement(axis, "LinearFunction", name="function")
                SubElement(function, "coefficients").text = "1 0"
            else:
                SubElement(SubElement(axis, "Constant", name="function"), "value").text = "0"
    return element
