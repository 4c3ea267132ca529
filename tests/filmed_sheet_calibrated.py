"""A made sheet with a texture that turns and waves before calibrated cameras with a lens."""

import cv2
import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from tests.filmed_sheet import texture

SIDE = 0.3
"""Of the sheet [m]."""
PICTURE = 160


def rig(degrees: tuple[float, ...] = (0.0, 12.0, -10.0)) -> Rig:
    """Cameras a metre before the sheet, so many degrees about the vertical."""
    cameras = []
    for number, angle in enumerate(np.radians(degrees)):
        turn = rotations.exp(np.array([0.0, angle, 0.02 * number]))
        cameras.append(
            Camera(
                name=f"cam{number + 1:02d}",
                size=(PICTURE, PICTURE),
                matrix=np.array([[400.0, 0, 79.5], [0, 405.0, 80.5], [0, 0, 1]]),
                distortion=np.array([-0.1, 0.01, 0.0, 0.0]),
                camera_from_world=RigidTransform(turn, np.array([0.0, 0.0, 1.0])),
            )
        )
    return Rig(tuple(cameras))


def in_space(places: np.ndarray, frame: int) -> np.ndarray:
    """Where places (P, 2) of the sheet, in metres from its middle, are in the world (P, 3) [m]."""
    (x, y), t = np.asarray(places).T, frame / 4
    height = 0.015 * np.sin(x / 0.06 + t) + 0.012 * np.cos(y / 0.05 + 0.7 * t)
    turn = rotations.exp(np.array([0.15 * np.sin(t), 0.2 * np.sin(1.4 * t + 1), 0.05 * t]))
    return np.stack([x, y, height], axis=1) @ turn.T + [0.02 * np.sin(t / 2), 0, 0]


def on_sheet(camera: Camera, pixels: np.ndarray, frame: int) -> np.ndarray:
    """Which places (P, 2) of the sheet are seen at pixels: undone by fixed-point steps [m]."""
    found = (np.asarray(pixels, float) - PICTURE / 2) / 400
    for _ in range(9):
        away = np.nan_to_num(pixels - camera.project(in_space(found, frame)))
        found = np.clip(found + 1.0 * away / 400, -SIDE, SIDE)
    return found


def picture(camera: Camera, frame: int, grey: np.ndarray, seed: int) -> np.ndarray:
    rows, columns = np.mgrid[:PICTURE, :PICTURE]
    places = on_sheet(camera, np.stack([columns.ravel(), rows.ravel()], 1).astype(float), frame)
    x, y = (places.T / SIDE + 0.5) * (len(grey) - 1)
    maps = (part.reshape(PICTURE, PICTURE).astype(np.float32) for part in (x, y))
    made = cv2.remap(grey.astype(np.float32), *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    made += np.random.default_rng(seed).standard_normal(made.shape)
    return np.clip(np.round(made), 0, 255).astype(np.uint8)


def videos(frames: int) -> list[list[np.ndarray]]:
    grey = texture()
    return [
        [picture(camera, frame, grey, 100 * number + frame) for frame in range(frames)]
        for number, camera in enumerate(rig())
    ]
