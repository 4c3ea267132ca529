"""Anatomical angles after the ISB from the rotations of segments, with standard deviations.

Every segment gets an anatomical frame in the rest posture: X anterior, Y proximal (up), Z to the right ([Wu2002],
[Wu2005]). Joint angles are the Cardan or Euler angles of the distal frame in the proximal one;
docs/explanation/angles.md lists them all. Unlike the papers, no landmark is palpated: the frames come from joint
centres and hinges of the body at rest.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.body.articulation.skeleton import Skeleton
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.continuity import continuous_angles
from marey.geometry.vectors import unit

FORWARD, UP, RIGHT = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0])
"""Directions of the body at rest, which faces -y with its left side at +x."""
WORLD_FRAME = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Reference of the pelvis' and thorax' angles: X along world y (OpenSim's x), Y along world z, Z along world x."""
NEXT_DISTAL = {"thigh": "shank", "shank": "foot", "upperarm": "forearm", "forearm": "hand"}
"""Maps each segment of a limb to the next distal one."""
SIDE_PREFIXES = ("left_", "right_")
"""Prefixes of the names of segments and angles of a side."""
_SINGULARITY_OFFSET = 1e-6
"""Offset of the middle angle from a singularity of its sequence [rad]; numerical."""
LARGEST_ANGLE_SD = np.pi
"""Upper bound of an angle's standard deviation [rad]: half a rotation; larger values occur near a singularity."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnatomicalJoint:
    """One row of the table of joints: the two segments, the sequence of rotations, and the names of the angles."""

    child: str
    """The distal segment."""
    parent: str | None
    """The proximal segment; None for the world."""
    sequence: str
    """Axes of the three intrinsic rotations."""
    angles: tuple[tuple[int, str, float], ...]
    """(position in the sequence, name, sign of its positive direction)."""
    sided: bool = False
    """Whether there is a left and a right one."""


_TRUNK = ((0, "flexion", -1.0), (1, "bending", 1.0), (2, "rotation", 1.0))
"""Positions, names and signs of the angles of trunk and head."""


def _named(joint: str, *angles: tuple[int, str, float]) -> tuple[tuple[int, str, float], ...]:
    return tuple((place, f"{joint}_{name}", sign) for place, name, sign in angles)


_ROOT = ((2, "tilt", -1.0), (1, "obliquity", 1.0), (0, "rotation", 1.0))
"""Positions, names and signs of the angles of pelvis and thorax in the world."""
_CARDAN = ((0, "flexion", 1.0), (1, "adduction", 1.0), (2, "rotation", 1.0))
"""Positions, names and signs of the angles of a joint with three Cardan angles."""
JOINTS = (
    AnatomicalJoint(child="pelvis", parent=None, sequence="YXZ", angles=_named("pelvis", *_ROOT)),
    AnatomicalJoint(child="thorax", parent=None, sequence="YXZ", angles=_named("thorax", *_ROOT)),
    AnatomicalJoint(child="thorax", parent="pelvis", sequence="ZXY", angles=_named("trunk", *_TRUNK)),
    AnatomicalJoint(child="head", parent="thorax", sequence="ZXY", angles=_named("head", *_TRUNK)),
    AnatomicalJoint(child="thigh", parent="pelvis", sequence="ZXY", angles=_named("hip", *_CARDAN), sided=True),
    AnatomicalJoint(
        child="shank",
        parent="thigh",
        sequence="ZXY",
        angles=_named("knee", (0, "flexion", -1.0), (1, "adduction", 1.0), (2, "rotation", 1.0)),
        sided=True,
    ),
    AnatomicalJoint(
        child="foot",
        parent="shank",
        sequence="ZXY",
        angles=_named("ankle", (0, "dorsiflexion", 1.0), (1, "inversion", 1.0), (2, "rotation", 1.0)),
        sided=True,
    ),
    AnatomicalJoint(
        child="toes", parent="foot", sequence="ZXY", angles=_named("toe", (0, "extension", 1.0)), sided=True
    ),
    AnatomicalJoint(
        child="clavicle",
        parent="thorax",
        sequence="YXZ",
        angles=_named("clavicle", (0, "protraction", 1.0), (1, "elevation", -1.0)),
        sided=True,
    ),
    AnatomicalJoint(
        child="upperarm",
        parent="thorax",
        sequence="YXY",
        angles=_named("shoulder", (0, "plane", 1.0), (1, "elevation", -1.0), (2, "axial_rotation", 1.0)),
        sided=True,
    ),
    AnatomicalJoint(child="upperarm", parent="thorax", sequence="ZXY", angles=_named("shoulder", *_CARDAN), sided=True),
    AnatomicalJoint(
        child="forearm",
        parent="upperarm",
        sequence="ZXY",
        angles=(*_named("elbow", (0, "flexion", 1.0), (1, "adduction", 1.0)), (2, "forearm_pronation", 1.0)),
        sided=True,
    ),
    AnatomicalJoint(
        child="hand",
        parent="forearm",
        sequence="ZXY",
        angles=_named("wrist", (0, "flexion", 1.0), (1, "ulnar_deviation", 1.0)),
        sided=True,
    ),
)
"""The table of joints. Signs are those of the right side; the left side is mirrored first, for the same meaning."""
FIXED_LEVERAGE = 0.1
"""Derivative of an angle by every coordinate of its joint at rest below which the model holds the angle still: 0.001 of
the elbow's adduction and 0.005 of the ankle's rotation, above 0.9 for all other angles of the full body."""
_UNWRAPPED = ("pelvis_rotation", "thorax_rotation")
"""Angles that are continuous beyond 360 degrees, because a person may turn on the spot more than once."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Anatomy:
    """The anatomical frames of a body's segments in the rest posture."""

    segment_names: tuple[str, ...]
    """S names."""
    frames: Floats
    """(S, 3, 3) axes as columns: X anterior, Y proximal, Z right, in the frame of the rest posture."""

    def __post_init__(self) -> None:
        freeze_fields(self, "frames")

    @property
    def angle_names(self) -> tuple[str, ...]:
        """Names of the angles available for this body's segments, in the table's order, left before right."""
        return tuple(f"{side}{name}" for joint, side in self.joints() for _, name, _ in joint.angles)

    @property
    def angle_segments(self) -> tuple[str, ...]:
        """Names of the segments whose rotations the angles describe."""
        return tuple(_pair(joint, side)[0] for joint, side in self.joints() for _ in joint.angles)

    def joints(self) -> list[tuple[AnatomicalJoint, str]]:
        """List the rows of the table whose segments exist, with the side's prefix."""
        rows = [(j, side) for j in JOINTS for side in (SIDE_PREFIXES if j.sided else ("",))]
        return [(j, side) for j, side in rows if all(s is None or s in self.segment_names for s in _pair(j, side))]


def _pair(joint: AnatomicalJoint, side: str) -> tuple[str, str | None]:
    """Return the names of the child and the parent segment of a joint on a side."""
    own = {"thigh", "shank", "foot", "toes", "clavicle", "upperarm", "forearm", "hand"}
    parent = f"{side}{joint.parent}" if joint.parent in own else joint.parent
    return f"{side}{joint.child}", parent


def segments_of_angle(name: str) -> tuple[str, str] | None:
    """Return the parent and the child segment of an angle of the table.

    Args:
        name: Name of the angle, such as `left_knee_flexion`.

    Returns:
        Their names, such as `left_thigh` and `left_shank`; None for another name, and for an angle in the world.
    """
    side = next((each for each in SIDE_PREFIXES if name.startswith(each)), "")
    for joint in JOINTS:
        if joint.sided == bool(side) and name.removeprefix(side) in [angle for _, angle, _ in joint.angles]:
            child, parent = _pair(joint, side)
            return None if parent is None else (parent, child)
    return None


def anatomy(
    segment_names: tuple[str, ...], joint_centres: Floats, transverse: Mapping[str, Floats] | None = None
) -> Anatomy:
    """Construct the anatomical frames of a body in the rest posture (upright, facing -y, z up).

    Trunk and head: the axes of the rest posture, so that their angles are zero at rest. Thigh, shank, upper arm and
    forearm: Y from the distal to the proximal joint centre. Clavicle: Z along it. Foot and toes: X from the ankle to
    the toes' joint, projected on the horizontal plane. Hand: as the forearm, straight at rest. The transverse direction
    (Z), made perpendicular to the first axis, completes each frame.

    Args:
        segment_names: S names.
        joint_centres: (S, 3) the segments' proximal joint centres at rest [m].
        transverse: For segments whose Z is not the rest posture's right, the direction at rest that points to the
            person's right in the anatomical position: for an upper arm the elbow's flexion axis, for a forearm the
            wrist's (about which flexion is positive), which determine the rotation of the arm at rest about itself.

    Returns:
        The frames.

    Raises:
        MareyError: A limb's segment has no distal joint.
    """
    centre = dict(zip(segment_names, np.asarray(joint_centres, float), strict=True))
    given = {} if transverse is None else transverse
    return Anatomy(
        segment_names=tuple(segment_names),
        frames=np.stack([_frame(name, centre, given) for name in segment_names]),
    )


def _frame(name: str, centre: Mapping[str, Floats], transverse: Mapping[str, Floats]) -> Floats:
    side, _, kind = name.rpartition("_")
    if kind in NEXT_DISTAL:
        distal = f"{side}_{NEXT_DISTAL[kind]}"
        if distal not in centre:
            raise MareyError(f"The segment {name!r} needs {distal!r} for the direction of its long axis.")
        return _from_y_and_z(centre[name] - centre[distal], transverse.get(name, RIGHT))
    if kind == "hand" and f"{side}_forearm" in centre:
        return _frame(f"{side}_forearm", centre, transverse)
    if kind == "clavicle" and f"{side}_upperarm" in centre:
        outwards = centre[f"{side}_upperarm"] - centre[name]
        z = unit(outwards if side == "right" else -outwards)
        x = unit(np.cross(UP, z))
        return np.stack([x, np.cross(z, x), z], -1)
    if kind in ("foot", "toes") and f"{side}_toes" in centre and f"{side}_foot" in centre:
        along = centre[f"{side}_toes"] - centre[f"{side}_foot"]
        return _from_y_and_z(UP, np.cross(along - (along @ UP) * UP, UP))
    return np.stack([FORWARD, UP, RIGHT], -1)


def _from_y_and_z(y: Floats, z: Floats) -> Floats:
    y = unit(np.asarray(y, float))
    x = unit(np.cross(y, z))
    return np.stack([x, y, np.cross(x, y)], -1)


def euler_angles(rotation: Floats, sequence: str) -> Floats:
    """Decompose rotations into three intrinsic rotations R_i(a) R_j(b) R_k(c).

    Args:
        rotation: (..., 3, 3).
        sequence: Three axes, such as "ZXY", or "YXY" with b from -pi to 0 (arm elevation, negative in [Wu2005]).

    Returns:
        (..., 3) a, b, c [rad]; a and c in -pi..pi.
    """
    i, j, k = ("XYZ".index(axis) for axis in sequence)
    if i == k:
        k = 3 - i - j
        e = 1.0 if (j - i) % 3 == 1 else -1.0
        a = np.arctan2(-rotation[..., j, i], e * rotation[..., k, i])
        b = -np.arctan2(np.hypot(rotation[..., j, i], rotation[..., k, i]), rotation[..., i, i])
        return np.stack([a, b, np.arctan2(-rotation[..., i, j], -e * rotation[..., i, k])], -1)
    e = 1.0 if (j - i) % 3 == 1 else -1.0
    a = np.arctan2(-e * rotation[..., j, k], rotation[..., k, k])
    b = np.arctan2(e * rotation[..., i, k], np.hypot(rotation[..., i, i], rotation[..., i, j]))
    return np.stack([a, b, np.arctan2(-e * rotation[..., i, j], rotation[..., i, i])], -1)


def euler_axes(angles: Floats, sequence: str) -> Floats:
    """Return the axes of the three rotations in the reference frame.

    Args:
        angles: (..., 3) [rad].
        sequence: Three axes.

    Returns:
        (..., 3, 3), one axis per column: a small rotation exp(w) R changes the angles by d where axes @ d = w.
    """
    own = [np.eye(3)["XYZ".index(axis)] for axis in sequence]
    first = rotations.about(own[0], angles[..., 0])
    second = first @ rotations.about(own[1], angles[..., 1])
    return np.stack([np.broadcast_to(own[0], angles.shape), first @ own[1], second @ own[2]], -1)


def anatomical_angles(body: Anatomy, segment_rotation: Floats) -> Floats:
    """Compute the anatomical angles of a motion.

    Args:
        body: The frames at rest.
        segment_rotation: (F, S, 3, 3) world from segment, the identity at rest; NaN without a pose.

    Returns:
        (F, A) [rad], positive as in docs/explanation/angles.md; pelvis' and thorax' turns in the world are continuous
        over time.
    """
    values = [
        sign * _joint_angles(body, segment_rotation, joint, side)[..., place]
        for joint, side in body.joints()
        for place, _, sign in joint.angles
    ]
    angles = np.stack(values, -1) if values else np.zeros((len(segment_rotation), 0))
    for name in set(_UNWRAPPED) & set(body.angle_names):
        column = body.angle_names.index(name)
        angles[:, column] = continuous_angles(angles[:, column])
    return angles


def _frames_in_world(
    body: Anatomy, segment_rotation: Floats, joint: AnatomicalJoint, side: str
) -> tuple[Floats, Floats]:
    child, parent = _pair(joint, side)
    at = body.segment_names.index
    inner = segment_rotation[:, at(child)] @ body.frames[at(child)]
    if parent is None:
        return np.broadcast_to(WORLD_FRAME, inner.shape), inner
    return segment_rotation[:, at(parent)] @ body.frames[at(parent)], inner


def _joint_angles(body: Anatomy, segment_rotation: Floats, joint: AnatomicalJoint, side: str) -> Floats:
    """Return a joint's three angles (F, 3) [rad] before signs, mirrored for the left side."""
    outer, inner = _frames_in_world(body, segment_rotation, joint, side)
    relative = np.swapaxes(outer, -1, -2) @ inner
    if side == "left_":
        mirror = np.diag([1.0, 1.0, -1.0])
        relative = mirror @ relative @ mirror
    return euler_angles(relative, joint.sequence)


def angles_with_sd(
    body: Anatomy, segment_rotation: Floats, turn_wrt_coordinates: Floats, covariance: Floats
) -> tuple[Floats, Floats]:
    """Compute the anatomical angles and their standard deviations to first order.

    Args:
        body: The frames at rest.
        segment_rotation: (F, S, 3, 3) world from segment.
        turn_wrt_coordinates: (F, S, 3, D) derivative of a small rotation w of each segment in the world,
            R <- exp(w) R, by each coordinate (see `turns_of_steps`).
        covariance: (F, D, D) covariance of the coordinates.

    Returns:
        Angles (F, A) [rad] and standard deviations (F, A) [rad]. Near a singularity of its sequence an angle's standard
        deviation grows without bound; it is limited to pi, which means that the angle is undetermined.
    """
    [deviations] = angle_deviations(body, segment_rotation, turn_wrt_coordinates, covariance)
    return anatomical_angles(body, segment_rotation), np.minimum(deviations, LARGEST_ANGLE_SD)


def angle_deviations(
    body: Anatomy, segment_rotation: Floats, turn_wrt_coordinates: Floats, *covariances: Floats
) -> list[Floats]:
    """Compute the standard deviations of the anatomical angles to first order, without a limit.

    Args:
        body: The frames at rest.
        segment_rotation: (F, S, 3, 3) world from segment.
        turn_wrt_coordinates: (F, S, 3, D), as in `angles_with_sd`.
        covariances: Covariances of the coordinates, (F, D, D) each, or (1, D, D) if all frames have the same.

    Returns:
        Standard deviations (F, A) [rad] for each covariance.
    """
    found: list[list[Floats]] = [[] for _ in covariances]
    for joint, side in body.joints():
        wrt = _joint_derivative(body, segment_rotation, joint, side, turn_wrt_coordinates)
        for deviations, covariance in zip(found, covariances, strict=True):
            variance = (wrt @ covariance * wrt).sum(-1)
            # NaN is kept; rounding may leave a variance of zero slightly negative.
            sd = np.sqrt(np.where(variance < 0, 0.0, variance))
            deviations += [sd[:, place] for place, _, _ in joint.angles]
    empty = np.zeros((len(segment_rotation), 0))
    return [np.stack(deviations, -1) if deviations else empty for deviations in found]


def _joint_derivative(
    body: Anatomy, segment_rotation: Floats, joint: AnatomicalJoint, side: str, turn_wrt_coordinates: Floats
) -> Floats:
    """Return the derivative (F, 3, D) of a joint's three angles by the coordinates."""
    child, parent = _pair(joint, side)
    outer, _ = _frames_in_world(body, segment_rotation, joint, side)
    turn = turn_wrt_coordinates[:, body.segment_names.index(child)]
    if parent is not None:
        turn = turn - turn_wrt_coordinates[:, body.segment_names.index(parent)]
    turn = np.swapaxes(outer, -1, -2) @ turn
    if side == "left_":  # a rotation is an axial vector: mirroring z changes the sign of its x and y
        turn = turn * np.array([-1.0, -1.0, 1.0])[:, None]
    angles = _joint_angles(body, segment_rotation, joint, side)
    return np.linalg.inv(euler_axes(_off_singularity(angles, joint.sequence), joint.sequence)) @ turn


def _off_singularity(angles: Floats, sequence: str) -> Floats:
    """Shift the middle angle slightly away from a singularity, where the first and the last axis coincide."""
    middle = angles[..., 1]
    lever = np.sin(middle) if sequence[0] == sequence[2] else np.cos(middle)
    nudged = np.where(np.abs(lever) < _SINGULARITY_OFFSET, middle + _SINGULARITY_OFFSET, middle)
    return np.stack([angles[..., 0], nudged, angles[..., 2]], -1)


def transverse_axes(skeleton: Skeleton) -> dict[str, Floats]:
    """Return the directions of the arms' hinges of a skeleton at rest, for `anatomy`.

    Returns:
        For each upper arm the elbow's, for each forearm the wrist's flexion axis (3,).
    """
    hinges = {"elbow_flexion": "upperarm", "wrist_flexion": "forearm"}
    wanted = {f"{side}_{c}": f"{side}_{s}" for side in ("left", "right") for c, s in hinges.items()}
    return {wanted[c.name]: np.array(c.axis) for c in skeleton.coordinates if c.name in wanted}


def anatomy_of(skeleton: Skeleton, joint_centres: Floats) -> Anatomy:
    """Return the anatomical frames of a body from its skeleton and joint centres (S, 3) at rest [m]."""
    return anatomy(skeleton.segment_names, joint_centres, transverse_axes(skeleton))


def turned_angles(skeleton: Skeleton, joint_centres: Floats) -> Mask:
    """Return which angles the coordinates of a skeleton can change; the model holds the others still.

    Such an angle is no measurement: the elbow and the ankle have two coordinates each, but three angles.

    Args:
        skeleton: The body's skeleton, with its free coordinates.
        joint_centres: (S, 3) joint centres at rest [m].

    Returns:
        (A,) in the order of `Anatomy.angle_names`.
    """
    body = anatomy_of(skeleton, joint_centres)
    turns = turns_of_steps(skeleton, skeleton.axes[None])
    rest = np.tile(np.eye(3), (1, len(body.segment_names), 1, 1))
    leverage = []
    for joint, side in body.joints():
        wrt = np.abs(_joint_derivative(body, rest, joint, side, turns)[0]).max(-1, initial=0.0)
        leverage += [float(wrt[place]) for place, _, _ in joint.angles]
    return np.array(leverage) > FIXED_LEVERAGE


def turns_of_steps(skeleton: Skeleton, world_axes: Floats) -> Floats:
    """Return the derivative of each segment's small rotation in the world by a step of the pose (`Pose.step`).

    Args:
        skeleton: The body's skeleton.
        world_axes: (F, D - 6, 3) axes of the joint coordinates in the world (`PosedBody.world_axes`).

    Returns:
        (F, S, 3, D): zero for the translation; the root's rotation acts on all segments, a joint coordinate on its
        descendants.
    """
    below = skeleton.above()[:, skeleton.coordinate_segment]
    frames, segments = len(world_axes), len(below)
    turns = np.zeros((frames, segments, 3, 6 + below.shape[1]))
    turns[..., 3:6] = np.eye(3)
    turns[..., 6:] = below[:, None, :] * np.swapaxes(world_axes, 1, 2)[:, None]
    return turns
