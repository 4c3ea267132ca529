"""Anatomical angles after the ISB, from the rotations of segments, with their standard deviations.

Every segment gets an anatomical frame in the rest posture: X anterior, Y proximal (up), Z to the right ([Wu2002],
[Wu2005]). Joint angles are the Cardan or Euler angles of the distal frame in the proximal one;
docs/explanation/angles.md lists them all. Unlike the papers, no landmark is palpated: the frames come from joint
centres and hinges of the body at rest.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.body.articulation.skeleton import Skeleton
from marey.errors import MareyError
from marey.geometry import rotations

FORWARD, UP, RIGHT = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0])
"""Directions of the body at rest, which looks along -y with its left side at +x."""
WORLD_FRAME = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""What the pelvis' and thorax' own angles refer to: X along world y (OpenSim's x), Y along world z, Z along world x."""
_DISTAL = {"thigh": "shank", "shank": "foot", "upperarm": "forearm", "forearm": "hand"}
_SINGULARITY_OFFSET = 1e-6
"""Offset of the middle angle from a singularity of its sequence [rad]; numerical."""
LARGEST_ANGLE_SD = np.pi
"""Upper bound of an angle's standard deviation [rad]: half a rotation; larger values occur near a singularity."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnatomicalJoint:
    """One row of the table of joints: what turns in what, in which sequence, and what the angles are called."""

    child: str
    parent: str | None
    """None: the world."""
    sequence: str
    """Axes of the three turns, each about the axis that the ones before have moved."""
    angles: tuple[tuple[int, str, float], ...]
    """(place in the sequence, name, sign of its positive direction)."""
    sided: bool = False
    """Whether there is one at the left and one at the right."""


_TRUNK = ((0, "flexion", -1.0), (1, "bending", 1.0), (2, "rotation", 1.0))


def _named(joint: str, *angles: tuple[int, str, float]) -> tuple[tuple[int, str, float], ...]:
    return tuple((place, f"{joint}_{name}", sign) for place, name, sign in angles)


_ROOT = ((2, "tilt", -1.0), (1, "obliquity", 1.0), (0, "rotation", 1.0))
_CARDAN = ((0, "flexion", 1.0), (1, "adduction", 1.0), (2, "rotation", 1.0))
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
"""The table; signs are the right side's: the left side is mirrored first, so that they mean the same."""
_UNWRAPPED = ("pelvis_rotation", "thorax_rotation")  # a person may turn on the spot more than once


@dataclass(frozen=True, eq=False, kw_only=True)
class Anatomy:
    """The anatomical frames of a body's segments in the rest posture."""

    segment_names: tuple[str, ...]
    """S names."""
    frames: Floats
    """(S, 3, 3), columns X anterior, Y proximal, Z right, in the axes of the rest posture."""

    def __post_init__(self) -> None:
        freeze_fields(self, "frames")

    @property
    def angle_names(self) -> tuple[str, ...]:
        """Names of the angles that this body's segments allow, in the table's order, left before right."""
        return tuple(f"{side}{name}" for joint, side in self.joints() for _, name, _ in joint.angles)

    @property
    def angle_segments(self) -> tuple[str, ...]:
        """Names of the segments whose turning the angles describe."""
        return tuple(_pair(joint, side)[0] for joint, side in self.joints() for _ in joint.angles)

    def joints(self) -> list[tuple[AnatomicalJoint, str]]:
        """List the rows of the table for which both segments are there, with the side's prefix."""
        rows = [(j, side) for j in JOINTS for side in (("left_", "right_") if j.sided else ("",))]
        return [(j, side) for j, side in rows if all(s is None or s in self.segment_names for s in _pair(j, side))]


def _pair(joint: AnatomicalJoint, side: str) -> tuple[str, str | None]:
    """Name the child and the parent segment of a joint on a side."""
    own = {"thigh", "shank", "foot", "toes", "clavicle", "upperarm", "forearm", "hand"}
    parent = f"{side}{joint.parent}" if joint.parent in own else joint.parent
    return f"{side}{joint.child}", parent


def anatomy(
    segment_names: tuple[str, ...], joint_centres: Floats, transverse: Mapping[str, Floats] | None = None
) -> Anatomy:
    """Find the anatomical frames of a body in the rest posture (upright, looking along -y, z up).

    Trunk and head: the axes of the rest posture itself, so that standing as at rest is zero. Thigh, shank, upper arm
    and forearm: Y from the distal to the proximal joint centre. Clavicle: Z along it. Foot and toes: X from the ankle
    to the toes' joint, made horizontal. Hand: as the forearm, straight at rest. The rest of each frame follows from
    the transverse direction (Z) made perpendicular to it.

    Args:
        segment_names: S names.
        joint_centres: (S, 3) the segments' proximal joint centres at rest [m].
        transverse: For segments whose Z is not the rest posture's right, the direction that points to the person's
            right in the anatomical position, at rest: for an upper arm the elbow's axis of flexion, for a forearm
            the wrist's (about which flexion is positive), which carry the turn of the arm at rest about itself.

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
    if kind in _DISTAL:
        distal = f"{side}_{_DISTAL[kind]}"
        if distal not in centre:
            raise MareyError(f"The segment {name!r} needs {distal!r} for the direction of its long axis.")
        return _from_y_and_z(centre[name] - centre[distal], transverse.get(name, RIGHT))
    if kind == "hand" and f"{side}_forearm" in centre:
        return _frame(f"{side}_forearm", centre, transverse)
    if kind == "clavicle" and f"{side}_upperarm" in centre:
        outwards = centre[f"{side}_upperarm"] - centre[name]
        z = _unit(outwards if side == "right" else -outwards)
        x = _unit(np.cross(UP, z))
        return np.stack([x, np.cross(z, x), z], -1)
    if kind in ("foot", "toes") and f"{side}_toes" in centre and f"{side}_foot" in centre:
        along = centre[f"{side}_toes"] - centre[f"{side}_foot"]
        return _from_y_and_z(UP, np.cross(along - (along @ UP) * UP, UP))
    return np.stack([FORWARD, UP, RIGHT], -1)


def _unit(vector: Floats) -> Floats:
    return vector / np.linalg.norm(vector)


def _from_y_and_z(y: Floats, z: Floats) -> Floats:
    y = _unit(np.asarray(y, float))
    x = _unit(np.cross(y, z))
    return np.stack([x, y, np.cross(x, y)], -1)


def euler_angles(rotation: Floats, sequence: str) -> Floats:
    """Split rotations into three turns R_i(a) R_j(b) R_k(c), each about the axis that the ones before have moved.

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
    """Give the axes about which the three turns act, seen from the frame before all of them.

    Args:
        angles: (..., 3) [rad].
        sequence: Three axes.

    Returns:
        (..., 3, 3), one axis a column: a small turn exp(w) R changes the angles by d where axes @ d = w.
    """
    unit = [np.eye(3)["XYZ".index(axis)] for axis in sequence]
    first = rotations.about(unit[0], angles[..., 0])
    second = first @ rotations.about(unit[1], angles[..., 1])
    return np.stack([np.broadcast_to(unit[0], angles.shape), first @ unit[1], second @ unit[2]], -1)


def anatomical_angles(body: Anatomy, segment_rotation: Floats) -> Floats:
    """Give the anatomical angles of a motion.

    Args:
        body: The frames at rest.
        segment_rotation: (F, S, 3, 3) world from segment, the identity at rest; NaN where there is no answer.

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
        column = angles[:, body.angle_names.index(name)]
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known])
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
    """Give a joint's three turns (F, 3) [rad] before signs, the left side's mirrored."""
    outer, inner = _frames_in_world(body, segment_rotation, joint, side)
    relative = np.swapaxes(outer, -1, -2) @ inner
    if side == "left_":
        mirror = np.diag([1.0, 1.0, -1.0])
        relative = mirror @ relative @ mirror
    return euler_angles(relative, joint.sequence)


def angles_with_sd(
    body: Anatomy, segment_rotation: Floats, turn_wrt_coordinates: Floats, covariance: Floats
) -> tuple[Floats, Floats]:
    """Give the anatomical angles and their standard deviations, to first order.

    Args:
        body: The frames at rest.
        segment_rotation: (F, S, 3, 3) world from segment.
        turn_wrt_coordinates: (F, S, 3, D) the small turn w of each segment in the world, R <- exp(w) R, by each
            coordinate (see `turns_by_difference`).
        covariance: (F, D, D) of the coordinates.

    Returns:
        Angles (F, A) [rad] and standard deviations (F, A) [rad]. Beside a singularity of its sequence an angle's
        standard deviation grows without bound; it ends at pi, which says that nothing is known.
    """
    deviations = []
    for joint, side in body.joints():
        wrt = _joint_derivative(body, segment_rotation, joint, side, turn_wrt_coordinates)
        variance = np.einsum("fad,fde,fae->fa", wrt, covariance, wrt, optimize=True)
        # NaN stays NaN: there is no answer; rounding may leave a variance of zero a little below zero.
        sd = np.minimum(np.sqrt(np.where(variance < 0, 0.0, variance)), LARGEST_ANGLE_SD)
        deviations += [sd[:, place] for place, _, _ in joint.angles]
    empty = np.zeros((len(segment_rotation), 0))
    return anatomical_angles(body, segment_rotation), np.stack(deviations, -1) if deviations else empty


def _joint_derivative(
    body: Anatomy, segment_rotation: Floats, joint: AnatomicalJoint, side: str, turn_wrt_coordinates: Floats
) -> Floats:
    """Give the derivative (F, 3, D) of a joint's three turns by the coordinates."""
    child, parent = _pair(joint, side)
    outer, _ = _frames_in_world(body, segment_rotation, joint, side)
    turn = turn_wrt_coordinates[:, body.segment_names.index(child)]
    if parent is not None:
        turn = turn - turn_wrt_coordinates[:, body.segment_names.index(parent)]
    turn = np.swapaxes(outer, -1, -2) @ turn
    if side == "left_":  # a turn is an axial vector: the mirror of z flips its x and y
        turn = turn * np.array([-1.0, -1.0, 1.0])[:, None]
    angles = _joint_angles(body, segment_rotation, joint, side)
    return np.linalg.inv(euler_axes(_off_singularity(angles, joint.sequence), joint.sequence)) @ turn


def _off_singularity(angles: Floats, sequence: str) -> Floats:
    """Move the middle angle a hair off where the first and the last axis fall together."""
    middle = angles[..., 1]
    lever = np.sin(middle) if sequence[0] == sequence[2] else np.cos(middle)
    nudged = np.where(np.abs(lever) < _SINGULARITY_OFFSET, middle + _SINGULARITY_OFFSET, middle)
    return np.stack([angles[..., 0], nudged, angles[..., 2]], -1)


def transverse_axes(skeleton: Skeleton) -> dict[str, Floats]:
    """Read from a skeleton which way the arms' hinges point at rest, as `anatomy` takes them.

    Returns:
        For each upper arm the elbow's, for each forearm the wrist's axis of flexion (3,).
    """
    hinges = {"elbow_flexion": "upperarm", "wrist_flexion": "forearm"}
    wanted = {f"{side}_{c}": f"{side}_{s}" for side in ("left", "right") for c, s in hinges.items()}
    return {wanted[c.name]: np.array(c.axis) for c in skeleton.coordinates if c.name in wanted}


def anatomy_of(skeleton: Skeleton, joint_centres: Floats) -> Anatomy:
    """Give the anatomical frames of a body: its skeleton and joint centres (S, 3) at rest [m]."""
    return anatomy(skeleton.segment_names, joint_centres, transverse_axes(skeleton))


def turns_of_steps(skeleton: Skeleton, world_axes: Floats) -> Floats:
    """Give each segment's small turn in the world by each number of a step of the pose (`Pose.step`).

    Args:
        skeleton: The body's.
        world_axes: (F, D - 6, 3) axes of the joint coordinates in the world (`PosedBody.world_axes`).

    Returns:
        (F, S, 3, D): translation turns nothing, the root's turn all, a joint coordinate what hangs below it.
    """
    below = skeleton.above()[:, skeleton.coordinate_segment]
    frames, segments = len(world_axes), len(below)
    turns = np.zeros((frames, segments, 3, 6 + below.shape[1]))
    turns[..., 3:6] = np.eye(3)
    turns[..., 6:] = below[:, None, :] * np.swapaxes(world_axes, 1, 2)[:, None]
    return turns


def turns_by_difference(rotations_of: Callable[[Floats], Floats], coordinates: Floats, *, step: float = 1e-5) -> Floats:
    """Give each segment's small turn by each coordinate, by central differences.

    Args:
        rotations_of: Makes segment rotations (S, 3, 3) of coordinates (D,).
        coordinates: (F, D).
        step: Of the difference [rad or m].

    Returns:
        (F, S, 3, D), NaN in frames without coordinates.
    """
    frames = [_turns_of_one(rotations_of, q, step) if np.isfinite(q).all() else None for q in coordinates]
    known = [f for f in frames if f is not None]
    if not known:
        raise MareyError("No frame has coordinates: the turns of the segments cannot be found.")
    return np.stack([np.full_like(known[0], np.nan) if f is None else f for f in frames])


def _turns_of_one(rotations_of: Callable[[Floats], Floats], q: Floats, step: float) -> Floats:
    columns = []
    for d in range(len(q)):
        change = np.zeros_like(q)
        change[d] = step
        after, before = rotations_of(q + change), rotations_of(q - change)
        columns.append(rotations.log(after @ np.swapaxes(before, -1, -2)) / (2 * step))
    return np.stack(columns, -1)
