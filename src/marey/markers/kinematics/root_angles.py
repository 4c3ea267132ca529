"""Angles of the pelvis and the thorax in the laboratory, with standard deviations."""

from collections.abc import Iterator

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.geometry.continuity import continuous_angles
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.motion.anatomical import JOINTS, LARGEST_ANGLE_SD, WORLD_FRAME, AnatomicalJoint, euler_angles

_STEP = 1e-6
"""Step of central differences [rad]; numerical."""


def with_root_angles(joints: JointKinematics, motion: BoneMotion, *, y_up: bool) -> JointKinematics:
    """Put tilt, obliquity and rotation of the pelvis and the thorax in the laboratory before the angles of joints.

    The angles are those of captured bodies ([Baker2001]): rotation about the vertical first, then obliquity, then tilt.
    The rotation is zero if the person faces along Y of a laboratory with Z up, or along X of one with Y up.

    Args:
        joints: Angles of joints.
        motion: Bones with anatomical frames.
        y_up: Whether Y points up in the laboratory; otherwise Z does.

    Returns:
        The angles of joints, with those of the segments that are in the motion.
    """
    names, angles, spreads = list[str](), list[Floats](), list[Floats]()
    for root in _roots(motion):
        values, sds = _angles(motion, root, np.eye(3) if y_up else WORLD_FRAME)
        names += [name for _, name, _ in root.angles]
        angles.append(values)
        spreads.append(sds)
    if not names:
        return joints
    return JointKinematics(
        angle_names=(*names, *joints.angle_names),
        angles=np.concatenate([*angles, joints.angles], 1),
        angles_sd=np.concatenate([*spreads, joints.angles_sd], 1),
        translation_names=joints.translation_names, translations=joints.translations,
        translations_sd=joints.translations_sd,
    )  # fmt: skip


def _roots(motion: BoneMotion) -> Iterator[AnatomicalJoint]:
    """Yield the rows of the table of joints that are relative to the laboratory, for the segments of the motion."""
    return (joint for joint in JOINTS if joint.parent is None and joint.child in motion.segments)


def _angles(motion: BoneMotion, root: AnatomicalJoint, reference: Floats) -> tuple[Floats, Floats]:
    """Return the angles (F, 3) of a segment relative to a reference (3, 3), and their standard deviations [rad]."""
    s = motion.segments.index(root.child)
    relative, covariance = reference.T @ motion.rotation[:, s], motion.covariance[:, s, :3, :3]
    order, signs = [place for place, _, _ in root.angles], np.array([sign for _, _, sign in root.angles])

    def evaluated(rotation: Floats) -> Floats:
        return np.asarray(euler_angles(rotation, root.sequence)[:, order] * signs)

    columns = []
    for axis in np.eye(3):
        ahead, behind = (evaluated(relative @ rotations.exp(sign * _STEP * axis)) for sign in (1.0, -1.0))
        # An angle may jump by 360 degrees between the two.
        columns.append(np.angle(np.exp(1j * (ahead - behind))) / (2 * _STEP))
    wrt = np.stack(columns, -1)
    variance = np.einsum("fnk,fkl,fnl->fn", wrt, covariance, wrt)
    sds = np.minimum(np.sqrt(np.maximum(variance, 0.0)), LARGEST_ANGLE_SD)
    return continuous_angles(evaluated(relative), centred=True), sds
