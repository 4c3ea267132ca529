"""Joint angles and translations between two bones after Grood and Suntay, with standard deviations."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry import rotations
from marey.geometry.continuity import continuous_angles
from marey.geometry.vectors import products, unit
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration
from marey.motion.anatomical import JOINTS, LARGEST_ANGLE_SD, SIDE_PREFIXES, euler_angles

TRANSLATIONS = ("lateral", "anterior", "distraction")
"""Names of the three translations, in the order of the joint's axes ([Grood1983])."""
_SEQUENCE = "ZXY"
"""Sequence of the Cardan angles that equal the angles of [Grood1983]."""
_DEFAULT_ANGLES = (("flexion", 1.0), ("adduction", 1.0), ("rotation", 1.0))
"""Names and signs of the angles of joints without names of their own."""
MIDWAY_SD_M, JOINT_SD_M, COUNTED_FRAMES = 0.1, 0.005, 10.0
"""Standard deviations of a joint's centre from the middle between the two bones' origins, and from a point at rest in
both bones [m]; number of frames for which all frames together count, because their errors are alike. Chosen by hand:
the middle decides only where the motion does not, such as along the axis of a hinge."""
_STEP = 1e-6
"""Step of central differences [rad or m]; numerical."""


@dataclass(frozen=True, kw_only=True)
class BoneJoint:
    """A joint between two bones, with the names of its angles."""

    parent: str
    child: str
    name: str
    """`left_knee`, or `child_on_parent` if the joint has no name of its own."""
    angles: tuple[tuple[str, float], ...]
    """Names and signs of the rotations about the parent's Z, the floating X and the child's Y."""
    left: bool = False
    """Whether the joint is mirrored, so that the signs have the same meaning on both sides."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointPoint:
    """The centre of a joint, which is one place in the reference posture, in the frames of both bones."""

    parent: Floats
    """(3,) in the frame of the parent [m]."""
    child: Floats
    """(3,) in the frame of the child [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "parent", "child")


@dataclass(frozen=True, eq=False, kw_only=True)
class JointKinematics:
    """Angles and translations of joints over F frames; NaN where one of the bones has no pose."""

    angle_names: tuple[str, ...]
    """A names."""
    angles: Floats
    """(F, A) angles [rad]."""
    angles_sd: Floats
    """(F, A) standard deviations [rad]; NaN where unknown."""
    translation_names: tuple[str, ...] = ()
    """T names."""
    translations: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(F, T) translations [m]."""
    translations_sd: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(F, T) standard deviations [m]; NaN where unknown."""

    def __post_init__(self) -> None:
        freeze_fields(self, "angles", "angles_sd", "translations", "translations_sd")


def joint_of(parent: str, child: str, side: str | None = None) -> BoneJoint:
    """Create the joint between two bones, with the usual names.

    Args:
        parent: The proximal bone, the reference of the angles, such as `left_thigh`, `thigh`, `pelvis`.
        child: The distal bone, such as `left_shank`.
        side: `left` or `right` if the names do not contain it; without either the signs are those of a right side.

    Returns:
        The joint.
    """
    own = next((s for s in SIDE_PREFIXES if child.startswith(s)), "")
    at_left = own == "left_" or (not own and side == "left")
    for row in JOINTS:
        if row.sequence == _SEQUENCE and row.child == child.removeprefix(own):
            wanted = {row.parent, f"{own}{row.parent}"}
            if parent in wanted:
                joint = row.angles[0][1].partition("_")[0]
                named = {place: (f"{own}{name}", sign) for place, name, sign in row.angles}
                words = enumerate(_DEFAULT_ANGLES)
                angles = tuple(named.get(k, (f"{own}{joint}_{word}", sign)) for k, (word, sign) in words)
                return BoneJoint(parent=parent, child=child, name=f"{own}{joint}", left=at_left, angles=angles)
    name = f"{child}_on_{parent}"
    angles = tuple((f"{name}_{word}", sign) for word, sign in _DEFAULT_ANGLES)
    return BoneJoint(parent=parent, child=child, name=name, left=at_left, angles=angles)


def usual_joints(segments: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """List the pairs (parent, child) of bones that form a joint of the human body, by their names."""
    found = []
    for child in segments:
        side = next((s for s in SIDE_PREFIXES if child.startswith(s)), "")
        for row in JOINTS:
            if row.sequence == _SEQUENCE and row.parent is not None and row.child == child.removeprefix(side):
                parent = next((p for p in (f"{side}{row.parent}", row.parent) if p in segments), None)
                if parent is not None and (parent, child) not in found:
                    found.append((parent, child))
    return tuple(found)


def joint_point(motion: BoneMotion, joint: BoneJoint, reference: AnatomicalCalibration) -> JointPoint:
    """Find the centre of a joint: the place that moves least in both bones, near the middle between their origins.

    Args:
        motion: The motion of the bones.
        joint: The joint.
        reference: The poses of the bones in the reference posture, the first of it.

    Returns:
        The centre, at one place in the reference posture.
    """
    p, c = reference.segments.index(joint.parent), reference.segments.index(joint.child)
    turned = reference.rotation[0, p].T
    start, reach = turned @ reference.rotation[0, c], turned @ (reference.origin[0, c] - reference.origin[0, p])
    parent_rotation, parent_origin, child_rotation, child_origin = _poses(motion, joint)
    inverse = np.swapaxes(parent_rotation, -1, -2)
    relative, apart = inverse @ child_rotation, products(inverse, child_origin - parent_origin)
    known = np.isfinite(relative).all((1, 2)) & np.isfinite(apart).all(1)
    # Unknowns are the place in the child, then in the parent; they are one place in the reference posture.
    rows = np.concatenate([relative[known], np.broadcast_to(-np.eye(3), (int(known.sum()), 3, 3))], -1)
    weight = np.sqrt(COUNTED_FRAMES / max(int(known.sum()), 1)) / JOINT_SD_M
    middle = np.concatenate([np.zeros((3, 3)), np.eye(3)], 1) / MIDWAY_SD_M
    wanted = np.concatenate([-weight * apart[known].ravel(), 0.5 * reach / MIDWAY_SD_M])
    found = np.linalg.lstsq(np.concatenate([weight * rows.reshape(-1, 6), middle]), wanted, rcond=None)[0]
    return JointPoint(child=found[:3], parent=start @ found[:3] + reach)


def joint_kinematics(
    motion: BoneMotion, joints: Sequence[BoneJoint], points: Mapping[str, JointPoint] | None = None
) -> JointKinematics:  # fmt: skip
    """Compute the angles and translations of joints, with standard deviations to first order.

    The joint coordinate system of [Grood1983]: flexion about the parent's Z (to the right), rotation about the child's
    Y (upward), adduction about the floating axis perpendicular to both. The angles equal the Cardan angles Z-X-Y of the
    child in the parent ([Wu2002]). The displacement of the joint's centre in the child from that in the parent is
    projected on the same three axes: lateral, anterior, and distraction (orthogonal projections, not skew components).
    The two bones' errors count as independent, even if they come from one estimate.

    Args:
        motion: Bones whose frames are anatomical: X anterior, Y proximal, Z to the right.
        joints: Joints between bones of this motion.
        points: Centre of each joint, by its name; by default the origins of the two bones.

    Returns:
        Angles that are continuous beyond 180 degrees, and translations.
    """
    values, spreads = [], []
    for joint in joints:
        six, sd = _with_sd(motion, joint, partial(clinical, joint, point=(points or {}).get(joint.name)))
        values.append(six)
        spreads.append(sd)
    names = [name for joint in joints for name, _ in joint.angles]
    shape = (len(motion), 0, 6)
    all_values = np.stack(values, 1) if values else np.zeros(shape)
    all_sd = np.stack(spreads, 1) if spreads else np.zeros(shape)
    angles = continuous_angles(all_values[..., :3].reshape(len(motion), -1), centred=True)
    return JointKinematics(
        angle_names=tuple(names), angles=angles,
        angles_sd=np.minimum(all_sd[..., :3].reshape(len(motion), -1), LARGEST_ANGLE_SD),
        translation_names=tuple(f"{j.name}_{name}" for j in joints for name in TRANSLATIONS),
        translations=all_values[..., 3:].reshape(len(motion), -1),
        translations_sd=all_sd[..., 3:].reshape(len(motion), -1),
    )  # fmt: skip


def clinical(
    joint: BoneJoint, parent_rotation: Floats, parent_origin: Floats, child_rotation: Floats, child_origin: Floats, *,
    point: JointPoint | None = None,
) -> Floats:  # fmt: skip
    """Compute a joint's three angles [rad] and three translations [m] ([Grood1983]).

    Args:
        joint: Signs of the angles and side.
        parent_rotation: (..., 3, 3) laboratory from parent.
        parent_origin: (..., 3) [m].
        child_rotation: (..., 3, 3) laboratory from child.
        child_origin: (..., 3) [m].
        point: The centre of the joint; by default the origins of the two bones.

    Returns:
        (..., 6) angles and translations.
    """
    inverse = np.swapaxes(parent_rotation, -1, -2)
    relative = inverse @ child_rotation
    reach = products(inverse, child_origin - parent_origin)
    if point is not None:
        reach = reach + relative @ point.child - point.parent
    if joint.left:
        mirror = np.array([1.0, 1.0, -1.0])
        relative = mirror[:, None] * relative * mirror
        reach = reach * mirror
    angles = euler_angles(relative, _SEQUENCE) * np.array([sign for _, sign in joint.angles])
    # The floating axis is the parent's X rotated by the flexion: perpendicular to the parent's Z and the child's Y.
    long_axis = relative[..., :, 1]
    floating = unit(np.stack([long_axis[..., 1], -long_axis[..., 0], np.zeros_like(long_axis[..., 0])], -1))
    along = [reach[..., 2], (reach * floating).sum(-1), -(reach * long_axis).sum(-1)]
    return np.concatenate([angles, np.stack(along, -1)], -1)


def turns_since(motion: BoneMotion, pairs: Sequence[tuple[str, str]], frame: int) -> JointKinematics:
    """Compute the angle by which each child has rotated in its parent since a frame, without anatomical axes.

    Args:
        motion: Bones with arbitrary frames.
        pairs: Pairs (parent, child).
        frame: Index of the reference frame.

    Returns:
        One angle per joint, such as `knee_total_rotation`, from 0 to pi, without translations.
    """
    columns, spreads = [], []
    for parent, child in pairs:
        joint = joint_of(parent, child)
        parent_rotation, _, child_rotation, _ = _poses(motion, joint)
        start = parent_rotation[frame].T @ child_rotation[frame]

        def turned(r: Floats, _p: Floats, s: Floats, _q: Floats, start: Floats = start) -> Floats:
            between = np.swapaxes(r, -1, -2) @ s
            return np.asarray(np.linalg.norm(rotations.log(between @ start.T), axis=-1)[..., None])

        value, sd = _with_sd(motion, joint, turned)
        columns.append(value[:, 0])
        spreads.append(np.minimum(sd[:, 0], LARGEST_ANGLE_SD))
    empty = np.zeros((len(motion), 0))
    return JointKinematics(
        angle_names=tuple(f"{joint_of(*pair).name}_total_rotation" for pair in pairs),
        angles=np.stack(columns, -1) if columns else empty,
        angles_sd=np.stack(spreads, -1) if spreads else empty,
        translations=empty, translations_sd=empty,
    )  # fmt: skip


def _poses(motion: BoneMotion, joint: BoneJoint) -> list[Floats]:
    """Return rotation (F, 3, 3) and origin (F, 3) of the parent, then of the child."""
    p, c = motion.segments.index(joint.parent), motion.segments.index(joint.child)
    return [motion.rotation[:, p], motion.origin[:, p], motion.rotation[:, c], motion.origin[:, c]]


def _with_sd(motion: BoneMotion, joint: BoneJoint, function: Callable[..., Floats]) -> tuple[Floats, Floats]:
    """Evaluate a function (F, n) of two bones' poses, with its standard deviation (F, n) by central differences."""
    bones = _poses(motion, joint)
    value = function(*bones)
    variance = np.zeros_like(value)
    for place, segment in ((0, joint.parent), (2, joint.child)):
        wrt = np.stack([_difference(function, bones, place, axis) for axis in range(6)], -1)
        covariance = motion.covariance[:, motion.segments.index(segment)]
        variance = variance + np.einsum("fnk,fkl,fnl->fn", wrt, covariance, wrt)
    return value, np.sqrt(np.maximum(variance, 0.0))


def _difference(function: Callable[..., Floats], bones: list[Floats], place: int, axis: int) -> Floats:
    """Differentiate by one of a bone's six errors: rotation about its own axes, then origin in the laboratory."""
    ends = []
    for sign in (1.0, -1.0):
        moved = list(bones)
        if axis < 3:
            moved[place] = bones[place] @ rotations.exp(sign * _STEP * np.eye(3)[axis])
        else:
            moved[place + 1] = bones[place + 1] + sign * _STEP * np.eye(3)[axis - 3]
        ends.append(function(*moved))
    change = ends[0] - ends[1]
    # An angle may jump by 360 degrees between the two.
    change = np.where(np.abs(change) > np.pi, change - np.sign(change) * 2 * np.pi, change)
    return change / (2 * _STEP)
