"""Small worlds whose truth is known: the family's body in a pose, seen by a ring of cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import Skeleton
from marey.body.articulation.surface import Body
from marey.body.people.family import DetailLevel as Detail
from marey.body.people.person import family_body
from marey.cameras.camera import Camera
from marey.fit.recipes.person import SilhouetteTake
from marey.fit.search.levels import FrameLevels
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.observations.correspondence import view_of

RATE = 30.0
ARMS_AND_KNEES = {
    "left_shoulder_lift": 40, "right_shoulder_lift": -20, "left_elbow_flexion": 60, "right_elbow_flexion": 25,
    "left_hip_flexion": 25, "left_knee_flexion": 35, "right_knee_flexion": 10, "thoracic_rotation": 10,
}  # fmt: skip
"""A posture without symmetry, whose every segment shows in some of the ring's cameras [deg]."""


def looking_at(
    target: Floats, centre: Floats, *, name: str = "cam", size: tuple[int, int] = (200, 240), focal: float = 300.0
) -> Camera:
    """A pinhole camera at a centre that has a target in the middle of its image, upright in a world of Z up."""
    ahead = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    matrix = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    return Camera(
        name=name, size=size, matrix=matrix, distortion=np.zeros(4),
        camera_from_world=RigidTransform(rotation, -rotation @ centre),
    )  # fmt: skip


def ring(
    count: int = 4, *, size: tuple[int, int] = (200, 240), focal: float = 300.0, distance: float = 3.2,
    target: Sequence[float] = (0.0, 0.0, -0.05),
) -> tuple[Camera, ...]:  # fmt: skip
    """Cameras all round a person who stands with the pelvis at the world's origin; none stands opposite another."""
    cameras = []
    for i in range(count):
        bearing = np.deg2rad(20 + 0.85 * i * 360 / count)
        centre = np.array([distance * np.cos(bearing), distance * np.sin(bearing), 0.3 + 0.25 * (i % 2)])
        cameras.append(looking_at(np.array(target), centre, name=f"cam{i + 1:02d}", size=size, focal=focal))
    return tuple(cameras)


@lru_cache
def person(detail: Detail = "coarse", numbers: int = 6) -> Body:
    """The mean body of the family's first few numbers."""
    return family_body(detail, numbers)


def scan(detail: Detail = "coarse") -> Body:
    """A person whose shape is known, as that of a scan: there are no shape parameters."""
    body = person(detail)
    return replace(body, space=body.space.keep(range(0)), numbers=np.zeros(0))


def column(skeleton: Skeleton, name: str) -> int:
    """Where a coordinate stands in a pose's angles."""
    return [c.name for c in skeleton.coordinates].index(name)


def pose(
    body: Body, degrees: Mapping[str, float] = ARMS_AND_KNEES, *, yaw: float = 0.0, at: Sequence[float] = (0, 0, 0)
) -> Pose:
    """A pose of some coordinates in degrees, facing away from -Y by a yaw [rad]."""
    angles = np.zeros(len(body.skeleton) - 6)
    for name, value in degrees.items():
        angles[column(body.skeleton, name)] = np.deg2rad(value)
    turn = rotations.about(np.array([0.0, 0.0, 1.0]), np.array(yaw))
    return Pose(np.array(at, float), turn, angles)


def silhouettes(posed: PosedBody, cameras: Sequence[Camera]) -> list[Mask]:
    """What the cameras see, by the project's own rasteriser."""
    return [view_of(posed, camera).mask() for camera in cameras]


def seen(
    posed: Sequence[PosedBody], cameras: Sequence[Camera], *, noise: float = 0.0, rng: np.random.Generator | None = None
) -> list[list[Mask]]:
    """The silhouettes of a motion, frame by frame, with noise on their outlines [px] if a generator is given."""
    masks = [silhouettes(p, cameras) for p in posed]
    return masks if rng is None else [[rough(mask, rng, spread=noise) for mask in frame] for frame in masks]


def take(posed: Sequence[PosedBody], cameras: Sequence[Camera]) -> SilhouetteTake:
    """A take of a motion, with one posed body per frame."""
    masks = seen(posed, cameras)
    return SilhouetteTake(tuple(cameras), lambda frame: masks[frame], tuple(range(len(posed))), RATE)


def levels(
    posed: Sequence[PosedBody], cameras: Sequence[Camera], factor: float = 1.0, *, noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> FrameLevels:  # fmt: skip
    """The silhouettes of a motion at one size."""
    masks = seen(posed, cameras, noise=noise, rng=rng)
    return FrameLevels(cameras, lambda frame: masks[frame], factor)


def swing(body: Body, frames: int, *, first: Mapping[str, float] = ARMS_AND_KNEES) -> list[Pose]:
    """A smooth motion: the person walks on, and arms and legs swing."""
    phase = 2 * np.pi * np.arange(frames) / 30
    swung = {"left_shoulder_lift": 20, "right_hip_flexion": 25, "left_elbow_flexion": 15, "right_knee_flexion": 15}
    poses = []
    for t in phase:
        degrees = dict(first)
        for name, width in swung.items():
            degrees[name] = degrees.get(name, 0.0) + width * np.sin(t)
        poses.append(pose(body, degrees, yaw=0.3 * np.sin(t), at=(0.1 * np.sin(t), 0.05 * t, 0.01 * np.sin(2 * t))))
    return poses


def joint_errors(found: PosedBody, true: PosedBody) -> Floats:
    """Distances (J,) of the reported joint centres [m]."""
    index = found.body.joint_segments
    return np.linalg.norm(found.segment_origin[index] - true.segment_origin[index], axis=1)


def rough(mask: Mask, rng: np.random.Generator, *, spread: float, grain: float = 3.0) -> Mask:
    """Move an outline in and out by smooth noise of a spread and a grain [px], as an imperfect segmentation does."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    noise = cv2.GaussianBlur(rng.normal(size=mask.shape), (0, 0), grain)
    return np.where(mask, inside - 0.5, 0.5 - outside) + spread * noise / noise.std() > 0
