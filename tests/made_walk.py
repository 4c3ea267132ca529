"""A made walk of an ellipsoid before free-running cameras, with its silhouettes."""

from collections.abc import Sequence

import cv2
import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.clocks import Clocks
from tests import worlds

RATE = 30.0
FRAMES = 100


def cameras(count: int = 4) -> list[Camera]:
    return list(worlds.ring(count=count, size=(320, 240), focal=260.0, target=(0.0, 0.0, 1.0)))


def clocks(offsets: Sequence[float], drifts: Sequence[float] | None = None) -> Clocks:
    """True clocks from offsets in frames."""
    count = len(offsets)
    return Clocks(
        names=tuple(f"cam{c + 1:02d}" for c in range(count)), offset_s=np.array(offsets) / RATE,
        drift=np.zeros(count) if drifts is None else np.array(drifts), offset_sd_s=np.zeros(count),
        drift_sd=np.zeros(count),
    )  # fmt: skip


def skin(instant: float, *, still: bool = False) -> np.ndarray:
    """Points (n, 3) of the surface at an instant [m]: it strolls about, bobs, and turns."""
    time = 0.0 if still else instant
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 24), np.linspace(-np.pi / 2, np.pi / 2, 17))
    ball = np.stack([np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height)], -1).reshape(-1, 3)
    centre = np.array([0.5 * np.sin(1.3 * time), 0.4 * np.sin(0.9 * time + 1), 1.0 + 0.05 * np.sin(9 * time)])
    turn = 0.8 * time
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return ball * [0.3, 0.2, 0.6] @ rotation.T + centre


def silhouettes(
    seen_by: Sequence[Camera], true: Clocks, *, frames: Sequence[int] | None = None,
    rates: Sequence[float] | None = None, still: bool = False, readouts: Sequence[float] | None = None,
) -> list[list[np.ndarray]]:  # fmt: skip
    """Silhouettes of each camera's pictures, taken on its own clock; readouts [s] below 0 are from the bottom."""
    counts = frames or [FRAMES] * len(seen_by)
    masks = []
    for c, camera in enumerate(seen_by):
        times = np.arange(counts[c]) / (RATE if rates is None else rates[c])
        readout = 0.0 if readouts is None else readouts[c]
        masks.append([_read(camera, instant, readout, still) for instant in true.instants(c, times)])
    return masks


def _read(camera: Camera, instant: float, readout: float, still: bool) -> np.ndarray:
    """The silhouette whose rows, in bands, are of the instants at which a rolling shutter exposes them."""
    mask = np.zeros((camera.height, camera.width), bool)
    for rows in np.array_split(np.arange(camera.height), 12 if readout else 1):
        late = readout * (rows.mean() / (camera.height - 1) - 0.5)
        mask[rows] = drawn(camera, skin(instant + late, still=still))[rows]
    return mask


def drawn(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Draw the silhouette of a convex body."""
    mask = np.zeros((camera.height, camera.width), np.uint8)
    hull = cv2.convexHull(camera.project(points).astype(np.float32))
    cv2.fillConvexPoly(mask, np.round(hull * 16).astype(np.int32), 1, shift=4)
    return mask.astype(bool)
