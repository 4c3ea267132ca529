"""Conversion of a fitted sequence to a motion: joints, coordinates and angles with standard deviations."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import ROOT_AXES, Skeleton, root_angles
from marey.body.articulation.surface import Body
from marey.fit.recipes.sequence import SequenceFit
from marey.geometry import rotations
from marey.motion.anatomical import anatomy_of, angle_deviations, angles_with_sd, turned_angles, turns_of_steps
from marey.motion.motion import FILLED, LOST, MEASURED, NO_PERSON, BodyMotion

DETERMINED = 0.5
"""A coordinate or an angle is determined where its own frame alone gives a standard deviation below this ratio to its
spread in people. Chosen by hand; results were not measured against other values."""
ROOT_SPREAD = (0.2, 0.2, 0.2, 0.5, 0.5, 0.5)
"""The spread for the coordinates of the root [m, rad]; a larger uncertainty is useless. Chosen by hand."""
_PRIOR_RATIO = 1e-3
"""Information of that spread, as a ratio to its inverse variance, which keeps the information invertible; numerical."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredPiece:
    """The part of a fitted sequence that is kept in a motion, for a piece of n frames."""

    frames: Integers
    """(n,) frame indices of the video."""
    rotation: Floats
    """(n, S, 3, 3) world from segment."""
    origin: Floats
    """(n, S, 3) origins of the segments in the world [m]."""
    joints_sd: Floats
    """(n, J, 3) standard deviations of the joint centres [m]."""
    coordinates: Floats
    """(n, D) coordinates [m or rad]."""
    coordinates_sd: Floats
    """(n, D) standard deviations [m or rad]."""
    determined: Mask
    """(n, D) True where a frame determines the coordinate."""
    angles: Floats
    """(n, A) anatomical angles [rad]."""
    angles_sd: Floats
    """(n, A) standard deviations [rad]."""
    angles_determined: Mask
    """(n, A) True where a frame determines the angle."""


def measure_piece(fit: SequenceFit) -> MeasuredPiece:
    """Extract the motion from a piece of a fitted sequence, so that its covariances can be released."""
    body, skeleton = fit.body, fit.body.skeleton
    degrees = len(skeleton)
    posed = [PosedBody(body, pose) for pose in fit.poses]
    rotation = np.array([p.segment_rotation for p in posed])
    covariance = fit.covariance[:, :degrees, :degrees]
    turns = turns_of_steps(skeleton, np.array([p.world_axes for p in posed]))
    anatomy = anatomy_of(skeleton, body.joint_centres)
    angles, angles_sd = angles_with_sd(anatomy, rotation, turns, covariance)
    own, usual = _own_covariance(fit.information, skeleton)
    angle_own_sd, angle_spread = angle_deviations(anatomy, rotation, turns, own, np.diag(usual**2)[None])
    to_root = np.array([root_coordinates_from_turn(pose.rotation) for pose in fit.poses])
    return MeasuredPiece(
        frames=fit.frames,
        rotation=rotation,
        origin=np.array([p.segment_origin for p in posed]),
        joints_sd=_joint_spread(posed, covariance),
        coordinates=np.array([coordinates_of(pose) for pose in fit.poses]),
        coordinates_sd=_coordinate_spread(covariance, to_root),
        determined=np.asarray(np.sqrt(np.diagonal(own, axis1=1, axis2=2)) < DETERMINED * usual),
        angles=angles,
        angles_sd=angles_sd,
        angles_determined=np.asarray(angle_own_sd < DETERMINED * angle_spread),
    )


def motion_of(
    pieces: Sequence[MeasuredPiece], body: Body, *, count: int, rate: float, lost: Mask, camera_names: tuple[str, ...],
    agreement: Mapping[int, Floats], filled: Collection[int] = (),
) -> BodyMotion:  # fmt: skip
    """Convert a fitted sequence to a motion with one row for every frame of the video.

    Angles that the model holds still are left out. Joint centres and angles that a preset does not follow are NaN. Its
    segments stay as at rest, for files that need a complete skeleton.

    Args:
        pieces: Pieces of the sequence, in order.
        body: The fitted body.
        count: Number of frames of the video.
        rate: Frames per second [Hz].
        lost: (count,) True for frames that show the person but have no pose.
        camera_names: C names.
        agreement: Maps each fitted frame to its agreement (C,) with the silhouettes.
        filled: Frames whose pose depends on their neighbours only.

    Returns:
        The motion.
    """
    skeleton = body.skeleton
    frames = np.concatenate([piece.frames for piece in pieces])
    state = np.where(lost, LOST, NO_PERSON)
    state[frames] = MEASURED
    state[list(filled)] = FILLED

    def rows(name: str) -> Floats:
        return _rows(np.concatenate([getattr(piece, name) for piece in pieces]), frames, count)

    anatomy = anatomy_of(skeleton, body.joint_centres)
    followed = np.ones(len(skeleton.segment_names), bool) if body.followed is None else body.followed
    turning = np.array([followed[skeleton.segment(name)] for name in anatomy.angle_segments], bool)
    free = turned_angles(skeleton, body.joint_centres)
    origin = rows("origin")
    coordinates = _without_jumps(np.concatenate([piece.coordinates for piece in pieces]))
    agreements = np.array([agreement[int(f)] for f in frames]).reshape(len(frames), len(camera_names))
    determined = np.zeros((count, len(skeleton)), bool)
    determined[frames] = np.concatenate([piece.determined for piece in pieces])
    angles_determined = np.zeros((count, len(anatomy.angle_names)), bool)
    angles_determined[frames] = np.concatenate([piece.angles_determined for piece in pieces])
    return BodyMotion(
        time=np.arange(count) / rate,
        rate=rate,
        joint_names=body.joint_names,
        joint_centres=_only(origin[:, body.joint_segments], body.followed_joints),
        joint_centres_sd=_only(rows("joints_sd"), body.followed_joints),
        segment_names=skeleton.segment_names,
        segment_rotation=rows("rotation"),
        segment_origin=origin,
        coordinate_names=skeleton.coordinate_names,
        coordinates=_rows(coordinates, frames, count),
        coordinates_sd=rows("coordinates_sd"),
        determined=determined,
        angle_names=tuple(name for name, kept in zip(anatomy.angle_names, free, strict=True) if kept),
        angles_deg=_only(np.degrees(rows("angles")), turning)[:, free],
        angles_deg_sd=_only(np.degrees(rows("angles_sd")), turning)[:, free],
        angles_determined=(angles_determined & turning)[:, free],
        state=state,
        camera_names=camera_names,
        agreement=_rows(agreements, frames, count),
    )


def joint_centre_sds(motion: BodyMotion, body: Body) -> tuple[float, float]:
    """Return the median standard deviation of a coordinate of a joint centre, from frame to frame and as a whole.

    The whole includes the constant offset of each joint centre within the body, which the motion does not show.

    Args:
        motion: The motion.
        body: The fitted body.

    Returns:
        Both [m]; NaN without a measured joint.
    """
    own = motion.joint_centres_sd
    offset = np.zeros(own.shape[1]) if body.joint_offset_sd is None else body.joint_offset_sd[body.joint_segments]
    known = np.isfinite(own)
    if not known.any():
        return float("nan"), float("nan")
    return float(np.median(own[known])), float(np.median(np.hypot(own, offset[:, None])[known]))


def _only(values: Floats, measure_piece: Mask) -> Floats:
    """Set columns (F, n, ...) that are not measured to NaN."""
    return np.where(measure_piece.reshape(1, -1, *[1] * (values.ndim - 2)), values, np.nan)


def _rows(values: Floats, frames: Integers, count: int) -> Floats:
    """Expand values to one row for every frame of the video; NaN in the other frames."""
    full = np.full((count, *values.shape[1:]), np.nan)
    full[frames] = values
    return full


def coordinates_of(pose: Pose) -> Floats:
    """Return the coordinates (D,) of a pose: position [m] and angles [rad] of the root, then joint angles [rad]."""
    return np.concatenate([pose.translation, root_angles(pose.rotation), pose.angles])


def _without_jumps(coordinates: Floats) -> Floats:
    """Unwrap the root's angles in coordinates (F, D)."""
    coordinates[:, 3:6] = np.unwrap(coordinates[:, 3:6], axis=0)
    return coordinates


def root_coordinates_from_turn(rotation: Floats) -> Floats:
    """Return the derivative (3, 3) of the root's three angles by a small rotation about the world's axes."""
    turns = root_angles(rotation)
    axes = np.array(ROOT_AXES)
    first = rotations.about(axes[0], turns[0])
    second = first @ rotations.about(axes[1], turns[1])
    by_coordinate = np.stack([axes[0], first @ axes[1], second @ axes[2]], 1)
    return np.linalg.pinv(by_coordinate)


def _coordinate_spread(covariance: Floats, to_root: Floats) -> Floats:
    variance = np.diagonal(covariance, axis1=1, axis2=2).copy()
    variance[:, 3:6] = np.einsum("fij,fjk,fik->fi", to_root, covariance[:, 3:6, 3:6], to_root)
    return np.sqrt(np.maximum(variance, 0.0))


def _joint_spread(posed: list[PosedBody], covariance: Floats) -> Floats:
    """Return the standard deviation (F, J, 3) of joint centres [m] from the poses and the joints' position in the body.

    The part that is constant over the take (the body's shape parameters) is not included; it is in body.npz.
    """
    spread = []
    for p, c in zip(posed, covariance, strict=True):
        jacobian = p.pose_jacobian(*p.joint_parts(p.body.joint_segments))
        variance = np.einsum("jad,de,jae->ja", jacobian, c, jacobian)
        beneath = np.zeros(len(variance)) if p.body.joint_sd is None else p.body.joint_sd[p.body.joint_segments]
        spread.append(np.sqrt(np.maximum(variance, 0.0) + beneath[:, None] ** 2))
    return np.array(spread)


def _own_covariance(information: Floats, skeleton: Skeleton) -> tuple[Floats, Floats]:
    """Return the covariance (F, D, D) that each frame alone gives, and the spread (D,) of the coordinates in people."""
    spread = np.concatenate([ROOT_SPREAD, skeleton.habit[1]])
    return np.linalg.inv(information + _PRIOR_RATIO * np.diag(1.0 / spread**2)), spread
