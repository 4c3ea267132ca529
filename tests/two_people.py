"""A take of two people who do not touch, rendered by the project's own depth buffer: images, key points and truth."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Floats, Image
from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.io.calibration.readers import write_cameras_toml
from marey.observations.correspondence import view_of
from tests import worlds
from tests.detected import detections, openpose, write_folder

SHIRTS = (
    {"head": (90, 120, 190), "trunk": (60, 60, 200), "pelvis": (70, 40, 30), "upperarm": (60, 60, 200)},
    {"head": (100, 130, 180), "trunk": (180, 120, 40), "pelvis": (40, 110, 60), "upperarm": (180, 120, 40)},
)
"""Colours of the parts of each person, blue first; other parts have that of the skin or, on the legs, of the pelvis."""
SKIN = (100, 130, 180)


def motions(frames: int) -> list[list[PosedBody]]:
    """Return the poses of a tall and a short person who walk about 1.4 m apart and hide each other in some images."""
    bodies = [person_body("fine", preset="full", stature_m=height) for height in (1.82, 1.64)]
    found = []
    for k, body in enumerate(bodies):
        posed = []
        for f in range(frames):
            t = 2 * np.pi * f / 40 + 2.1 * k
            swing = {
                "left_shoulder_lift": 35 + 20 * np.sin(t), "right_shoulder_lift": -25 + 20 * np.sin(t),
                "left_elbow_flexion": 45 + 20 * np.cos(t), "right_elbow_flexion": 30 - 15 * np.cos(t),
                "left_hip_flexion": 20 * np.sin(t), "right_hip_flexion": -20 * np.sin(t),
                "left_knee_flexion": 20 + 15 * np.cos(t), "right_knee_flexion": 20 - 15 * np.cos(t),
            }  # fmt: skip
            side = 1 - 2 * k
            at = (0.7 * side, side * (0.025 * f - 0.3), 0.0)
            posed.append(PosedBody(body, worlds.pose(body, swing, yaw=np.pi * k + 0.2 * np.sin(t), at=at)))
        found.append(posed)
    return found


def cameras() -> tuple[Camera, ...]:
    return worlds.ring(4, size=(480, 360), focal=400.0, distance=4.6)


def room(camera: Camera, rng: np.random.Generator) -> Image:
    """A room of coarse blotches."""
    grey = cv2.GaussianBlur(rng.normal(size=(camera.height, camera.width)), (0, 0), 5)
    tint = np.array([1.0, 1.04, 1.1]) * (135 + 260 * grey[..., None])
    return np.clip(tint, 0, 255).astype(np.uint8)


def picture(camera: Camera, empty: Image, people: Sequence[PosedBody], rng: np.random.Generator) -> Image:
    """What a camera sees: the nearer surface hides the farther one; with noise of 2 grey levels."""
    image, nearest = empty.astype(float), np.zeros((camera.height, camera.width))
    for posed, shirt in zip(people, SHIRTS, strict=True):
        view = view_of(posed, camera)
        x, y = view.corner
        height, width = view.face.shape
        part = (slice(y, y + height), slice(x, x + width))
        shown = (view.face >= 0) & (view.inverse_depth > nearest[part])
        shade = 0.9 + 0.2 * np.random.default_rng(5).random(len(posed.body.faces))
        colours = shade[:, None] * _face_colours(posed, shirt)
        image[part][shown] = colours[view.face[shown]]
        nearest[part][shown] = view.inverse_depth[shown]
    smooth = cv2.GaussianBlur(image, (0, 0), 0.6)
    return np.clip(smooth + rng.normal(size=image.shape) * 2, 0, 255).astype(np.uint8)


def _face_colours(posed: PosedBody, shirt: dict[str, tuple[int, int, int]]) -> Floats:
    from marey.body.articulation.skeleton import COLOUR_PARTS

    legs = {"thigh": shirt["pelvis"], "shank": SKIN, "foot": (40, 40, 40)}
    table = np.array([shirt.get(name, legs.get(name, SKIN)) for name in COLOUR_PARTS], float)
    return table[np.maximum(posed.body.face_colour_part, 0)]


def write_take(folder: Path, *, frames: int, plates: bool, noise_px: float = 2.0) -> list[list[PosedBody]]:
    """Write the trial with key points in `pose/`, and return the true poses of both people."""
    folder.mkdir(parents=True)
    rng, people, rig = np.random.default_rng(11), motions(frames), cameras()
    write_cameras_toml(Rig(tuple(replace(camera) for camera in rig)), folder / "cameras.toml")
    for camera in rig:
        empty = room(camera, rng)
        if plates:
            (folder / "background").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / "background" / f"{camera.name}.png"), empty)
        code = cv2.VideoWriter_fourcc(*"mp4v")
        video = cv2.VideoWriter(str(folder / f"{camera.name}.mp4"), code, worlds.RATE, camera.size)
        for f in range(frames):
            video.write(picture(camera, empty, [motion[f] for motion in people], rng))
        video.release()
    pixels, _ = detections(people, rig, noise=noise_px, rng=rng)
    views = [[[openpose(each) for each in of_camera] for of_camera in of_frame] for of_frame in pixels]
    write_folder(folder / "pose", [camera.name for camera in rig], views)
    return people


def joint_errors_of(out: Path, truth: Sequence[PosedBody]) -> Floats:
    """Distances (F, J) of the joints of the limbs in a folder of results [m]; NaN in frames without a result."""
    with np.load(out / "motion.npz") as motion:
        names = [str(name) for name in motion["joint_names"]]
        limbs = [i for i, name in enumerate(names) if name.startswith(("left", "right")) and "toe" not in name]
        found = motion["joint_centres"][: len(truth), limbs]
    index = truth[0].body.joint_segments
    own = [list(truth[0].body.joint_names).index(names[i]) for i in limbs]
    true = np.array([posed.segment_origin[index][own] for posed in truth])
    return np.asarray(np.linalg.norm(found - true, axis=2))
