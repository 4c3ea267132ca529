"""A made sheet with a texture that turns and waves before several orthographic cameras."""

import cv2
import numpy as np

from marey.geometry import rotations

SIZE = 200
MIDDLE = (SIZE - 1) / 2
CAMERAS = (0.0, 0.22, -0.2)
"""Turns of the cameras about the vertical [rad]."""


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((SIZE, SIZE))
    grey = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return 128 + 40 * grey / grey.std()


def in_space(points: np.ndarray, frame: int) -> np.ndarray:
    """Where points (P, 2) of the sheet are (P, 3) [px]."""
    (x, y), t = (points - MIDDLE).T, frame / 4
    height = 12 * np.sin(x / 40 + t) + 10 * np.cos(y / 35 + 0.7 * t) - 0.002 * x * y * np.sin(t)
    turn = rotations.exp(np.array([0.25 * np.sin(t), 0.25 * np.sin(1.4 * t + 1), 0.1 * t]))
    return np.stack([x, y, height], axis=1) @ turn.T


def place(points: np.ndarray, frame: int, camera: int) -> np.ndarray:
    """Where points (P, 2) of the sheet are in an image (P, 2) [px]."""
    turn = rotations.exp(np.array([0.0, CAMERAS[camera], 0.0]))
    return (in_space(points, frame) @ turn.T)[:, :2] + MIDDLE + (3 * frame / 4, 0)


def on_sheet(pixels: np.ndarray, frame: int, camera: int) -> np.ndarray:
    """Which points (P, 2) of the sheet are seen at pixels: the map is undone by fixed-point steps."""
    source = np.array(pixels, float)
    for _ in range(12):
        source += 0.9 * (pixels - place(source, frame, camera))
    return source


def picture(frame: int, camera: int, grey: np.ndarray, noise: float = 1.0) -> np.ndarray:
    rows, columns = np.mgrid[:SIZE, :SIZE]
    seen = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    x, y = on_sheet(seen, frame, camera).T.reshape(2, SIZE, SIZE).astype(np.float32)
    made = cv2.remap(grey.astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    made += noise * np.random.default_rng(1000 * camera + frame).standard_normal(made.shape)
    return np.clip(np.round(made), 0, 255).astype(np.uint8)


def videos(frames: int, cameras: int = 2, seed: int = 0) -> list[list[np.ndarray]]:
    grey = texture(seed)
    return [[picture(frame, camera, grey) for frame in range(frames)] for camera in range(cameras)]
