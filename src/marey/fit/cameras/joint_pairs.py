"""Start values for cameras from detected joints: relative poses of pairs of cameras, chained.

Each pair of cameras is placed by its essential matrix ([Nister2004], by OpenCV, robust), and the length of its baseline
by the lengths of the person's bones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.cameras.camera import Camera
from marey.cameras.triangulate import triangulate
from marey.geometry.rigid import RigidTransform

BONES = tuple(
    (f"{side}_{upper}", f"{side}_{lower}")
    for side in ("left", "right")
    for upper, lower in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
)
"""Bones whose lengths are constant, by the names of their joints."""
SURE = 0.5
"""Joints of less confidence are not used. Chosen by hand; with 0.8, the cameras of `walk` were no better."""
INLIER_RAD = 0.012
"""Largest distance of a joint from its epipolar line [rad]: a detector sees a joint elsewhere from each side. Chosen by
hand."""
LEAST_SHARED = 60
"""Least number of joints, in all frames, that two cameras must share. Chosen by hand."""
LEAST_ANGLE_RAD = 0.03
"""Least median angle between the rays of two cameras [rad], below which they do not determine their distance. Chosen
by hand."""
_START_SD_PX = 3.0
"""Standard deviation of a joint in the triangulation of the start [px]; it is common to all joints and cancels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointSightings:
    """Detected joints of one person in the images of all cameras."""

    joint_names: tuple[str, ...]
    """J names."""
    pixels: Floats
    """(F, C, J, 2) [px]; NaN where a joint was not found."""
    confidence: Floats
    """(F, C, J) from 0 to 1."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "confidence")

    @property
    def used(self) -> Mask:
        """(F, C, J) joints of sufficient confidence."""
        return np.asarray(np.isfinite(self.pixels[..., 0]) & (self.confidence >= SURE))

    def bones(self) -> Mapping[str, tuple[int, ...]]:
        """Return the numbers of the `first` and `second` joint of each bone of `BONES`."""
        place = {name: k for k, name in enumerate(self.joint_names)}
        return {
            "first": tuple(place[upper] for upper, _ in BONES), "second": tuple(place[lower] for _, lower in BONES)
        }  # fmt: skip

    def of_cameras(self, cameras: Sequence[int]) -> "JointSightings":
        """Return the joints in some of the cameras."""
        some = list(cameras)
        return replace(self, pixels=self.pixels[:, some], confidence=self.confidence[:, some])


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraPair:
    """The pose of a second camera relative to a first one."""

    second_from_first: RigidTransform
    agreeing: int
    """Number of joints that agree with it, in all frames."""


def chained_cameras(
    cameras: Sequence[Camera], seen: JointSightings, lengths_m: Floats
) -> tuple[tuple[Camera, ...], tuple[str, ...]]:
    """Place cameras one after the other, those that share most joints first.

    Args:
        cameras: C cameras, whose poses are ignored.
        seen: Detected joints.
        lengths_m: (B,) expected lengths of `BONES` [m].

    Returns:
        The cameras in the axes of one of them, and the names of those that could not be placed.
    """
    links = {}
    for i, j in combinations(range(len(cameras)), 2):
        pair = camera_pair(cameras[i], cameras[j], seen.of_cameras((i, j)), lengths_m)
        if pair is not None:
            links[i, j] = pair
    placed: dict[int, RigidTransform] = {}
    if links:
        placed[max(links, key=lambda pair: links[pair].agreeing)[0]] = RigidTransform.identity()
    while True:
        more = {pair: link for pair, link in links.items() if (pair[0] in placed) != (pair[1] in placed)}
        if not more:
            break
        (i, j), link = max(more.items(), key=lambda item: item[1].agreeing)
        if i in placed:
            placed[j] = link.second_from_first @ placed[i]
        else:
            placed[i] = link.second_from_first.inverse() @ placed[j]
    found = tuple(
        replace(camera, camera_from_world=placed.get(c, RigidTransform.identity())) for c, camera in enumerate(cameras)
    )
    return found, tuple(camera.name for c, camera in enumerate(cameras) if c not in placed)


def camera_pair(first: Camera, second: Camera, seen: JointSightings, lengths_m: Floats) -> CameraPair | None:
    """Find the pose of a second camera relative to a first one.

    Of the four poses that an essential matrix allows, that is used in which most joints lie before both cameras.

    Args:
        first: The first camera; its pose is ignored.
        second: The second camera; its pose is ignored.
        seen: Detected joints in these two cameras.
        lengths_m: (B,) expected lengths of `BONES` [m].

    Returns:
        The pose; None if too few joints agree, or the joints do not determine it.
    """
    both = seen.used.all(axis=1)
    one, other = first.undistort(seen.pixels[:, 0][both]), second.undistort(seen.pixels[:, 1][both])
    known = np.isfinite(one).all(1) & np.isfinite(other).all(1)
    if np.count_nonzero(known) < LEAST_SHARED:
        return None
    matrix, inside = cv2.findEssentialMat(
        one[known], other[known], np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=INLIER_RAD, maxIters=5000
    )
    if matrix is None or matrix.shape != (3, 3) or np.count_nonzero(inside) < LEAST_SHARED:
        return None
    count, turned, moved, _ = cv2.recoverPose(matrix, one[known], other[known], np.eye(3), mask=inside.copy())
    rotation, shift = np.array(turned, dtype=np.float64), np.array(moved, dtype=np.float64).ravel()
    pose = RigidTransform(rotation, shift)
    pair = (
        replace(first, camera_from_world=RigidTransform.identity()), replace(second, camera_from_world=pose)
    )  # fmt: skip
    points = triangulated_joints(pair, seen)
    if not _apart(pair, points) or count < LEAST_SHARED:
        return None
    scale = float(np.nanmedian(lengths_m / _median_lengths(points, seen)))
    if not np.isfinite(scale):
        return None
    return CameraPair(second_from_first=RigidTransform(rotation, scale * shift), agreeing=int(count))


def triangulated_joints(cameras: Sequence[Camera], seen: JointSightings) -> Floats:
    """Triangulate the joints of all frames (F, J, 3) [m]; NaN where they are not seen by two cameras."""
    frames, _, joints = seen.used.shape
    pixels = np.where(seen.used[..., None], seen.pixels, np.nan)
    flat = np.moveaxis(pixels, 1, 0).reshape(len(cameras), -1, 2)
    return np.array(triangulate(cameras, flat, sigma_px=_START_SD_PX).points.reshape(frames, joints, 3))


def _apart(pair: Sequence[Camera], points: Floats) -> bool:
    """Return whether two cameras see the joints from directions that differ enough."""
    known = points[np.isfinite(points[..., 0])]
    if not len(known):
        return False
    rays = [(known - camera.centre) / np.linalg.norm(known - camera.centre, axis=1, keepdims=True) for camera in pair]
    across = np.linalg.norm(np.cross(rays[0], rays[1]), axis=1)
    return bool(np.median(across) > LEAST_ANGLE_RAD)


def _median_lengths(points: Floats, seen: JointSightings) -> Floats:
    """Return the medians over frames of the lengths (B,) of bones; NaN for those that were never seen."""
    bones = seen.bones()
    lengths = np.linalg.norm(points[:, bones["first"]] - points[:, bones["second"]], axis=-1)
    return np.array([np.median(own[np.isfinite(own)]) if np.isfinite(own).any() else np.nan for own in lengths.T])
