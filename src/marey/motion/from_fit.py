"""From a fitted sequence to a motion: joints, coordinates and angles with their standard deviations."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import ROOT_AXES, Skeleton, root_angles
from marey.body.articulation.surface import Body
from marey.fit.recipes.sequence import SequenceFit
from marey.geometry import rotations
from marey.motion.anatomical import anatomy_of, angles_with_sd, turns_of_steps
from marey.motion.motion import FILLED, LOST, MEASURED, NOBODY, BodyMotion

DETERMINED = 0.5
"""A coordinate is determined where its own frame fixes it to this share of the spread that people's joints have."""
ROOT_SPREAD = (0.2, 0.2, 0.2, 0.5, 0.5, 0.5)
"""The same spread for the root [m, rad]: coarser, and nobody could say where the person is."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """What a motion keeps of a piece of a fitted sequence, n frames of it."""

    frames: Integers
    rotation: Floats
    """(n, S, 3, 3) world from segment."""
    origin: Floats
    """(n, S, 3) [m]."""
    joints_sd: Floats
    """(n, J, 3) [m]."""
    coordinates: Floats
    """(n, D)."""
    coordinates_sd: Floats
    determined: Mask
    """(n, D)."""
    angles: Floats
    """(n, A) [rad]."""
    angles_sd: Floats


def measured(fit: SequenceFit) -> Measured:
    """Say what a piece of a fitted sequence measured; its covariances are not needed after."""
    body, skeleton = fit.body, fit.body.skeleton
    degrees = len(skeleton)
    posed = [PosedBody(body, pose) for pose in fit.poses]
    rotation = np.array([p.segment_rotation for p in posed])
    covariance = fit.covariance[:, :degrees, :degrees]
    turns = turns_of_steps(skeleton, np.array([p.world_axes for p in posed]))
    angles, angles_sd = angles_with_sd(anatomy_of(skeleton, body.joint_centres), rotation, turns, covariance)
    to_root = np.array([root_coordinates_from_turn(pose.rotation) for pose in fit.poses])
    return Measured(
        frames=fit.frames,
        rotation=rotation,
        origin=np.array([p.segment_origin for p in posed]),
        joints_sd=_joint_spread(posed, covariance),
        coordinates=np.array([coordinates_of(pose) for pose in fit.poses]),
        coordinates_sd=_coordinate_spread(covariance, to_root),
        determined=_determined(fit.information, skeleton),
        angles=angles,
        angles_sd=angles_sd,
    )


def motion_of(
    pieces: Sequence[Measured], body: Body, *, count: int, rate: float, lost: Mask, camera_names: tuple[str, ...],
    agreement: Mapping[int, Floats], filled: Collection[int] = (),
) -> BodyMotion:  # fmt: skip
    """Write a fitted sequence as a motion with a row for every frame of the video.

    Joint centres and angles that a preset does not follow are NaN. Its segments stay as at rest, for the files that
    need a whole skeleton.

    Args:
        pieces: of the sequence, in order.
        body: that was fitted.
        count: frames of the video.
        rate: frames in a second.
        lost: (count,) frames that show the person without an answer.
        camera_names: C names.
        agreement: (C,) of each fitted frame.
        filled: frames of which only their neighbours spoke.
    """
    skeleton = body.skeleton
    frames = np.concatenate([piece.frames for piece in pieces])
    state = np.where(lost, LOST, NOBODY)
    state[frames] = MEASURED
    state[list(filled)] = FILLED

    def rows(name: str) -> Floats:
        return _rows(np.concatenate([getattr(piece, name) for piece in pieces]), frames, count)

    anatomy = anatomy_of(skeleton, body.joint_centres)
    followed = np.ones(len(skeleton.segment_names), bool) if body.followed is None else body.followed
    turning = np.array([followed[skeleton.segment(name)] for name in anatomy.angle_segments], bool)
    origin = rows("origin")
    coordinates = _without_jumps(np.concatenate([piece.coordinates for piece in pieces]))
    agreements = np.array([agreement[int(f)] for f in frames]).reshape(len(frames), len(camera_names))
    determined = np.zeros((count, len(skeleton)), bool)
    determined[frames] = np.concatenate([piece.determined for piece in pieces])
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
        angle_names=anatomy.angle_names,
        angles_deg=_only(np.degrees(rows("angles")), turning),
        angles_deg_sd=_only(np.degrees(rows("angles_sd")), turning),
        state=state,
        camera_names=camera_names,
        agreement=_rows(agreements, frames, count),
    )


def _only(values: Floats, measured: Mask) -> Floats:
    """Leave columns (F, n, ...) that nobody measured without an answer."""
    return np.where(measured.reshape(1, -1, *[1] * (values.ndim - 2)), values, np.nan)


def _rows(values: Floats, frames: Integers, count: int) -> Floats:
    """Give every frame of the video a row; NaN where there is no answer."""
    full = np.full((count, *values.shape[1:]), np.nan)
    full[frames] = values
    return full


def coordinates_of(pose: Pose) -> Floats:
    """Give the skeleton's coordinates (D,) in a pose: the root's place [m] and turns [rad], then the joints' [rad]."""
    return np.concatenate([pose.translation, root_angles(pose.rotation), pose.angles])


def _without_jumps(coordinates: Floats) -> Floats:
    """Let the root's turns (F, D) count on through full turns."""
    coordinates[:, 3:6] = np.unwrap(coordinates[:, 3:6], axis=0)
    return coordinates


def root_coordinates_from_turn(rotation: Floats) -> Floats:
    """Give how the root's three turns change (3, 3) with a small turn about the world's axes."""
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
    """Give the standard deviation (F, J, 3) of joint centres: the poses', and how far joints lie from where skin says.

    The part that is constant over the take (the body's own numbers) is left out; body.npz holds it.
    """
    spread = []
    for p, c in zip(posed, covariance, strict=True):
        jacobian = p.pose_jacobian(*p.joint_parts(p.body.joint_segments))
        variance = np.einsum("jad,de,jae->ja", jacobian, c, jacobian)
        beneath = np.zeros(len(variance)) if p.body.joint_sd is None else p.body.joint_sd[p.body.joint_segments]
        spread.append(np.sqrt(np.maximum(variance, 0.0) + beneath[:, None] ** 2))
    return np.array(spread)


def _determined(information: Floats, skeleton: Skeleton) -> Mask:
    """Tell which coordinates (F, D) their own frame fixes, without its neighbours' help."""
    spread = np.concatenate([ROOT_SPREAD, skeleton.habit[1]])
    own = np.linalg.inv(information + 1e-3 * np.diag(1.0 / spread**2))
    return np.asarray(np.sqrt(np.diagonal(own, axis1=1, axis2=2)) < DETERMINED * spread)
