"""A made person in a made room, filmed by cameras of any number and size: videos, calibration and true joints."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Floats, Image
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.people.person import family_body
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import write_cameras_toml
from marey.io.video.video_writer import VideoWriter
from marey.observations.correspondence import view_of

RATE = 30.0
DISTANCE = 4.0
"""Distance of the cameras from the person [m]."""
NOISE = 2.0
"""Noise of the images [grey levels]."""
SWINGS = (
    ("left_shoulder_lift", 25, 20), ("right_shoulder_lift", 15, -15), ("left_elbow_flexion", 45, 25),
    ("right_elbow_flexion", 30, -20), ("right_hip_flexion", 12, 22), ("left_hip_flexion", 12, -22),
    ("left_knee_flexion", 22, 18), ("right_knee_flexion", 22, -18),
)  # fmt: skip
"""Coordinates of the motion, with their middle and how far they swing [deg]."""
LIMB_JOINTS = [f"{s}_{j}" for s in ("left", "right") for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")]


def ring(count: int, size: tuple[int, int]) -> Rig:
    """Return cameras of an image size that look level at the middle of the room from all sides, all with one view."""
    focal = 1.6 * size[1]
    matrix = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    cameras = []
    for i in range(count):
        # Not opposite each other: two opposite cameras see the same outline.
        turn = upright @ rotations.about(np.array([0, 0, 1.0]), 0.2 + 2 * np.pi * i / count * (1 - 0.25 / count))
        pose = RigidTransform(turn, np.array([0.0, 1.0, DISTANCE]))
        cameras.append(
            Camera(name=f"cam{i + 1:02d}", size=size, matrix=matrix, distortion=np.zeros(4), camera_from_world=pose)
        )
    return Rig(tuple(cameras))


def walk_on_the_spot(body: Body, frames: int) -> list[PosedBody]:
    """Return the poses of a person who walks on the spot and turns a little."""
    return [walker_at(body, frame / RATE) for frame in range(frames)]


def walker_at(body: Body, time: float) -> PosedBody:
    """Return the pose at an instant [s] of a person who walks on the spot and turns a little, 50 steps in a minute."""
    names = [c.name for c in body.skeleton.coordinates]
    phase, angles = 2 * np.pi * time * RATE / 36, np.zeros(len(names))
    for name, middle, width in SWINGS:
        angles[names.index(name)] = np.deg2rad(middle + width * np.sin(phase))
    turn = rotations.about(np.array([0, 0, 1.0]), 0.4 * np.sin(phase / 3))
    lift = -float(body.vertices[:, 2].min())
    return PosedBody(body, Pose(np.array([0.1 * np.sin(phase / 2), 0.0, lift]), turn, angles))


def write_room(folder: Path, rig: Sequence[Camera], truth: Sequence[PosedBody], *, seed: int = 0) -> Path:
    """Write videos, images of the empty room and the calibration of a person whom cameras film.

    Args:
        folder: A folder that is created.
        rig: The cameras.
        truth: The person in each frame.
        seed: Seed of the random room and of the noise.
    """

    def body_at(time: float) -> PosedBody:
        return truth[round(time * RATE)]

    return write_filmed_room(folder, rig, body_at, len(truth) / RATE, [Filming()] * len(rig), seed=seed)


@dataclass(frozen=True, kw_only=True)
class Filming:
    """When a camera takes its pictures, and each row of them."""

    rate: float = RATE
    """Pictures per second [Hz]."""
    readout_s: float = 0.0
    """Time from the exposure of the first row to that of the last one [s]."""


ROLLING_BANDS = 12
"""Number of parts of a picture of a rolling shutter, each of which is drawn at the instant of its middle row."""


def write_filmed_room(
    folder: Path, rig: Sequence[Camera], body_at: Callable[[float], PosedBody], duration: float,
    filming: Sequence[Filming], *, seed: int = 0,
) -> Path:  # fmt: skip
    """Write what `write_room` writes, for cameras with frame rates and shutters of their own.

    Args:
        folder: A folder that is created.
        rig: The cameras.
        body_at: Returns the person at an instant [s]; that of a picture is the instant of its middle row.
        duration: Length of the videos [s].
        filming: How each camera films.
        seed: Seed of the random room and of the noise.
    """
    (folder / "background").mkdir(parents=True, exist_ok=True)
    write_cameras_toml(Rig(tuple(rig)), folder / "cameras.toml")
    rng = np.random.default_rng(seed)
    for camera, own in zip(rig, filming, strict=True):
        room = _room(camera, rng)
        cv2.imwrite(str(folder / "background" / f"{camera.name}.png"), _noisy(room, rng))
        with VideoWriter(folder / f"{camera.name}.mp4", camera.size, rate=own.rate, coding={"crf": "12"}) as writer:
            for picture in range(round(duration * own.rate)):
                writer.add(_noisy(_exposed(room, camera, body_at, picture / own.rate, own.readout_s), rng))
    return folder


def _exposed(
    room: Floats, camera: Camera, body_at: Callable[[float], PosedBody], time: float, readout_s: float
) -> Floats:
    """Return a picture (height, width, 3) whose middle row is exposed at an instant [s]."""
    if readout_s == 0:
        return next(_drawn(room, camera, [body_at(time)]))
    ends = np.linspace(0, camera.height, ROLLING_BANDS + 1).round().astype(int)
    middles = 0.5 * (ends[:-1] + ends[1:] - 1)
    instants = time + readout_s * (middles / (camera.height - 1) - 0.5)
    drawn = _drawn(room, camera, [body_at(instant) for instant in instants])
    return np.concatenate([image[a:b] for image, a, b in zip(drawn, ends[:-1], ends[1:], strict=True)])


def _room(camera: Camera, rng: np.random.Generator) -> Floats:
    """Return a room (height, width, 3) with stains of all sizes, equal in images of any size."""
    small = cv2.GaussianBlur(rng.uniform(60, 160, (90, 160, 3)), (0, 0), 2.0)
    return np.asarray(cv2.resize(small, camera.size, interpolation=cv2.INTER_CUBIC))


def _drawn(room: Floats, camera: Camera, truth: Sequence[PosedBody]) -> Iterator[Floats]:
    """Iterate over the images: each face of the person has the colour of its limb, darker where it is turned away."""
    colours = np.random.default_rng(1).uniform(20, 235, (32, 3))
    for posed in truth:
        faces, view = posed.body.faces, view_of(posed, camera)
        corners = posed.vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        towards = camera.centre - corners.mean(axis=1)
        shade = np.einsum("fk,fk->f", normals, towards)
        shade /= np.maximum(np.linalg.norm(normals, axis=1) * np.linalg.norm(towards, axis=1), 1e-12)
        colour = colours[posed.body.face_limb % len(colours)] * (0.4 + 0.6 * np.clip(shade, 0, 1))[:, None]
        image, (x, y), covered = room.copy(), view.corner, view.covered
        part = image[y : y + covered.shape[0], x : x + covered.shape[1]]
        part[covered] = colour[view.face[covered]]
        # The edge of a limb is as sharp as a lens makes it.
        yield cv2.GaussianBlur(image, (0, 0), 0.6)


def _noisy(image: Floats, rng: np.random.Generator) -> Image:
    return np.clip(np.round(image + NOISE * rng.normal(size=image.shape)), 0, 255).astype(np.uint8)


def limb_joints(posed: PosedBody) -> Floats:
    """Return the joint centres (12, 3) of the limbs [m]."""
    names = list(posed.body.joint_names)
    return posed.segment_origin[posed.body.joint_segments[[names.index(name) for name in LIMB_JOINTS]]]


def made_person(seed: int = 3) -> Body:
    """Return a person of the family, at random."""
    mean = family_body("fine")
    return mean.with_numbers(0.6 * np.random.default_rng(seed).normal(size=len(mean.numbers)))
