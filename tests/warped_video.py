"""A made video: a smooth random texture that moves and bends by a known map."""

import cv2
import numpy as np

SIZE = 160


def texture(seed: int = 0, size: int = SIZE) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((size, size))
    grey = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return 128 + 40 * grey / grey.std()


def place(points: np.ndarray, frame: int) -> np.ndarray:
    """Where points (P, 2) of frame 0 are in a frame: shift, turn and two bends, smooth in time."""
    t, middle = frame / 10, SIZE / 2
    x, y = ((points - middle) / middle).T
    turn = 0.12 * np.sin(t)
    shift_x = 9 * np.sin(1.3 * t) - turn * middle * y + 4 * np.sin(2 * t) * (x**2 - y)
    shift_y = 6 * (1 - np.cos(t)) + turn * middle * x + 4 * (1 - np.cos(1.7 * t)) * x * y
    return points + np.stack([shift_x, shift_y], axis=1)


def picture(frame: int, grey: np.ndarray, noise: float = 1.0) -> np.ndarray:
    """The texture as it is seen in a frame: the map is undone by fixed-point steps."""
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    seen = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    source = seen.copy()
    for _ in range(25):
        source += seen - place(source, frame)
    x, y = source.T.reshape(2, *grey.shape).astype(np.float32)
    made = cv2.remap(grey.astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    made += noise * np.random.default_rng(frame).standard_normal(made.shape)
    return np.clip(np.round(made), 0, 255).astype(np.uint8)


def video(frames: int, seed: int = 0, noise: float = 1.0) -> list[np.ndarray]:
    grey = texture(seed)
    return [picture(frame, grey, noise) for frame in range(frames)]
