"""The world of cameras that another program calibrated in any axes and unit, from the joints of a person in it.

The joints are triangulated with the given cameras. Bones set the unit, ankles on the floor its height, the trunk and,
for a walk, the horizontal way set the direction up, and the way or the hips the heading.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.cameras.camera import Camera
from marey.cameras.parameters import PARAMETERS
from marey.fit.cameras.from_joints import (
    LEAST_WAY,
    BoneLengths,
    block_basis,
    standing_world,
    way_of,
)
from marey.fit.cameras.joint_pairs import JointSightings, triangulated_joints
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

JOINT_OFFSET_M = 0.02
"""Standard deviation of the constant error of a triangulated joint, per axis [m]: see
`marey.fit.cameras.from_joints.BIAS_RAD`."""
ANKLE_HEIGHT_SD_M = 0.015
"""Standard deviation of the height of an ankle's centre above the floor [m]: people and shoes differ. By hand."""
LEAN_SD = np.radians(1.0)
"""Standard deviation of the mean lean of a person, to the side in a walk, and to all sides in standing [rad]. By
hand."""
GREATEST_RESIDUAL_RAD = 0.01
"""Median distance of the joints from their projections beyond which they contradict the cameras [rad].

0.003 to 0.005 in four rendered takes with one person, 0.07 or more in `market` and `office`, where the joints are those
of two people in turn."""
LEAST_BONE_FRAMES = 3
"""Least number of frames whose bones are seen. Chosen by hand."""
_FEWEST_BONES = 4
"""Least number of bones whose lengths are known; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonWorld:
    """Cameras in metres with Z up, X to the person's right, Y ahead and the floor at 0, and how well that is known."""

    cameras: tuple[Camera, ...]
    covariance: Floats
    """(15 C, 15 C) of the cameras' parameters due to the scale alone: the axes are chosen, not measured."""
    scale: float
    """Metres per unit of the given cameras."""
    scale_sd: float
    """Standard deviation of the scale, relative."""
    up_sd: float
    """Standard deviation of the direction up [rad], of either tilt."""
    floor_sd: float
    """Standard deviation of the floor's height under the person [m]."""
    heading_sd: float
    """Standard deviation of the heading [rad]."""
    walked: bool
    """Whether the person walks, so that the way sets the heading, and is horizontal."""
    backwards: bool
    """Whether the person walks backwards, as it seems, too, if right and left are exchanged."""
    residual_rad: float
    """Median distance of the joints from their projections [rad]."""

    @property
    def contradicted(self) -> bool:
        """Whether the joints contradict the cameras, so that the world is not known."""
        return not self.residual_rad < GREATEST_RESIDUAL_RAD

    def __post_init__(self) -> None:
        freeze_fields(self, "covariance")


def find_person_world(
    cameras: Sequence[Camera], seen: JointSightings, lengths: BoneLengths, *, keep_scale: bool = False
) -> PersonWorld | None:
    """Find the world of calibrated cameras from the joints of a person.

    Args:
        cameras: C cameras with lenses and poses, in any axes and unit.
        seen: Detected joints of one person.
        lengths: Expected lengths of the person's bones.
        keep_scale: Whether the unit of the cameras is the metre.

    Returns:
        The cameras in their world; None if too few joints are seen by two cameras.
    """
    points = triangulated_joints(cameras, seen)
    measured = _bone_logs(seen, points)
    known = np.isfinite(measured)
    if np.count_nonzero(known) < _FEWEST_BONES:
        return None
    information = np.linalg.inv(lengths.covariance[np.ix_(known, known)]).sum(axis=0)
    log_scale = float(information @ (np.log(lengths.expected_m) - measured)[known] / information.sum())
    scale, scale_sd = (1.0, 0.0) if keep_scale else (np.exp(log_scale), float(1.0 / np.sqrt(information.sum())))
    world = standing_world(seen.joint_names, scale * points)
    placed = world.apply(scale * points)
    trunk = _middle(seen, placed, "shoulder") - _middle(seen, placed, "ankle")
    way = way_of(_middle(seen, placed, "hip"))
    hips = _joint(seen, placed, "right_hip") - _joint(seen, placed, "left_hip")
    height, length = float(np.nanmedian(trunk[:, 2])), float(np.linalg.norm(way[:2]))
    walked = length > LEAST_WAY * height
    ahead = np.arctan2(way[1], way[0]) - np.pi / 2
    backwards = walked and np.cos(ahead) < 0
    heading = np.asarray(ahead + np.pi * backwards if walked else 0.0)
    turned = RigidTransform(rotations.about(np.array([0.0, 0.0, 1.0]), -heading), np.zeros(3)) @ world
    metric = tuple(scaled_camera(camera, scale).moved(turned) for camera in cameras)
    # The way of a walk is horizontal whatever the lean along it.
    across_way = np.array([way[1], -way[0]]) / length if walked else np.eye(2)
    lean = np.nanmedian(np.abs(trunk[:, :2] @ across_way.T).reshape(len(trunk), -1).max(axis=1) / trunk[:, 2])
    up_sd = np.linalg.norm([np.sqrt(2) * JOINT_OFFSET_M / height, LEAN_SD, 0.5 * lean])
    across = float(np.nanmedian(np.linalg.norm(hips, axis=1)))
    return PersonWorld(
        cameras=metric, covariance=scale_covariance(metric, scale_sd), scale=float(scale), scale_sd=scale_sd,
        up_sd=float(up_sd), floor_sd=float(np.hypot(ANKLE_HEIGHT_SD_M, JOINT_OFFSET_M)),
        heading_sd=float(np.sqrt(2) * JOINT_OFFSET_M / (length if walked else across)), walked=walked,
        backwards=bool(backwards), residual_rad=_residual(cameras, seen, points),
    )  # fmt: skip


def _residual(cameras: Sequence[Camera], seen: JointSightings, points: Floats) -> float:
    """Return the median distance of the joints (F, J, 3) from their projections, of the worst camera [rad]."""
    worst = 0.0
    for c, camera in enumerate(cameras):
        used = seen.used[:, c] & np.isfinite(points[..., 0])
        if used.any():
            apart = np.linalg.norm(camera.project(points[used]) - seen.pixels[:, c][used], axis=1)
            worst = max(worst, float(np.nanmedian(apart) / camera.matrix[0, 0]))
    return worst


def _joint(seen: JointSightings, points: Floats, name: str) -> Floats:
    return np.asarray(points[:, seen.joint_names.index(name)])


def _middle(seen: JointSightings, points: Floats, joint: str) -> Floats:
    return 0.5 * (_joint(seen, points, f"left_{joint}") + _joint(seen, points, f"right_{joint}"))


def _bone_logs(seen: JointSightings, points: Floats) -> Floats:
    """Return the logarithm (B,) of each bone's median length in the given unit; NaN where it is seldom seen."""
    bones = seen.bones()
    length = np.linalg.norm(points[:, list(bones["first"])] - points[:, list(bones["second"])], axis=2)
    count = np.isfinite(length).sum(axis=0)
    return np.array([
        np.log(np.nanmedian(own)) if number >= LEAST_BONE_FRAMES else np.nan
        for own, number in zip(length.T, count, strict=True)
    ])  # fmt: skip


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """Return a camera with the distances in another unit.

    Args:
        camera: The camera.
        scale: New units per present one.
    """
    pose = camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform(pose.rotation, scale * pose.translation))


def scale_covariance(cameras: Sequence[Camera], scale_sd: float) -> Floats:
    """Return the covariance (15 C, 15 C) of the parameters of cameras whose distances from the origin share a scale.

    Args:
        cameras: C cameras.
        scale_sd: Standard deviation of the scale, relative.
    """
    unknown = np.zeros((len(cameras), block_basis(cameras).shape[1] // len(cameras)))
    unknown[:, 3:6] = np.stack([camera.centre for camera in cameras])
    change = block_basis(cameras) @ unknown.ravel() * scale_sd
    assert len(change) == PARAMETERS * len(cameras)
    return np.outer(change, change)
