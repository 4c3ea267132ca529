"""Speed of a surface measurement: a speckled wall that three cameras see."""

import time

import cv2
import numpy as np

from marey.arrays import Floats, Image
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform
from marey.process import usable_cores
from marey.surface.points.dense import match_tuples
from marey.surface.points.intersection import intersect
from marey.surface.points.settings import SurfaceSettings
from marey.surface.points.views import comparisons, views_of

SIDE = 1024
"""Width and height of the images [px]."""
SPACING = 2
"""Distance of neighbouring points in the image [px]."""
SURFACE_LIMIT_S = 40.0
"""Limit for the measurement of one triplet of images [s]. Set by hand as what counts as fast enough."""
_ANGLES_DEG = (-12.0, 0.0, 12.0)
"""Directions of the three cameras [deg]."""
_WALL_M = 0.6
"""Width and height of the wall [m]."""
_SPECKLE_PX = 4.0
"""Width of the speckles on the wall, in pixels of its texture; slightly less in the images."""


def wall_rig() -> Rig:
    """Return three cameras at a distance of one metre from a wall at z = 0."""
    return Rig(tuple(_camera(f"cam{i + 1}", np.radians(angle)) for i, angle in enumerate(_ANGLES_DEG)))


def _camera(name: str, angle: float) -> Camera:
    centre = np.array([np.sin(angle), 0.1, np.cos(angle)])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0, 1.0, 0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.array([[1900.0, 0, SIDE / 2], [0, 1900.0, SIDE / 2], [0, 0, 1]])
    pose = RigidTransform(rotation, -rotation @ centre)
    return Camera(name=name, size=(SIDE, SIDE), matrix=matrix, distortion=np.zeros(4), camera_from_world=pose)


def wall_pictures(rig: Rig, rng: np.random.Generator) -> list[Image]:
    """Return images of the wall with a noise of one grey level."""
    texture = cv2.GaussianBlur(rng.normal(0, 1, (1600, 1600)).astype(np.float32), (0, 0), _SPECKLE_PX / 2)
    texture = 120 + 35 * texture / texture.std()
    wall_from_texture = np.array([[_WALL_M / 1600, 0, -_WALL_M / 2], [0, _WALL_M / 1600, -_WALL_M / 2], [0, 0, 1]])
    return [_filmed(camera, texture, wall_from_texture, rng) for camera in rig]


def _filmed(camera: Camera, texture: Floats, wall_from_texture: Floats, rng: np.random.Generator) -> Image:
    pose = camera.camera_from_world
    pixels_from_wall = camera.matrix @ np.column_stack([pose.rotation[:, :2], pose.translation])
    grey = cv2.warpPerspective(
        texture, pixels_from_wall @ wall_from_texture, camera.size, flags=cv2.INTER_CUBIC, borderValue=90
    )  # fmt: skip
    noisy = np.clip(np.round(grey + rng.normal(0, 1, grey.shape)), 0, 255).astype(np.uint8)
    return np.repeat(noisy[..., None], 3, axis=-1)


def surface_seconds(*, repeats: int = 2) -> tuple[float, int]:
    """Time the measurement of points from a triplet of images, as the best of some runs.

    Args:
        repeats: Number of runs.

    Returns:
        The time [s], and the number of measured points.
    """
    rig, settings = wall_rig(), SurfaceSettings(spacing=SPACING)
    images = wall_pictures(rig, np.random.default_rng(20060101))
    compared = comparisons(rig, angle=settings.angle, most_searched=settings.most_searched)[0]
    threads = usable_cores()
    best, count = np.inf, 0
    for _ in range(repeats):
        started = time.perf_counter()
        views = views_of(rig, images)
        count = len(intersect(views, match_tuples(views, compared, settings, threads=threads), settings, frame=0))
        best = min(best, time.perf_counter() - started)
    return best, count
