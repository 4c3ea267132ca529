"""A textured ball before cameras that stand around it: images with a known surface."""

from dataclasses import dataclass, replace

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform

RADIUS = 0.25
DISTANCE = 1.0
FOCAL = 420.0
SIZE = (260, 240)
GROUND = 90.0
WAVES = 40


def camera_at(name: str, angle_deg: float, *, height: float = 0.05) -> Camera:
    """A camera that looks at the origin from an angle about the vertical axis."""
    angle = np.radians(angle_deg)
    centre = DISTANCE * np.array([np.sin(angle), -np.cos(angle), height])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = [[FOCAL, 0, SIZE[0] / 2 - 0.3], [0, FOCAL, SIZE[1] / 2 + 0.4], [0, 0, 1]]
    return Camera(
        name=name, size=SIZE, matrix=matrix, distortion=[-0.1, 0.05, 0.001, -0.001],
        camera_from_world=RigidTransform(rotation, -rotation @ centre),
    )  # fmt: skip


def rig(*angles_deg: float) -> Rig:
    names = ("left", "middle", "right") if len(angles_deg) == 3 else [f"cam{i + 1:02d}" for i in range(len(angles_deg))]
    return Rig(tuple(camera_at(name, angle) for name, angle in zip(names, angles_deg, strict=True)))


@dataclass(frozen=True, eq=False)
class Ball:
    """A ball at the origin with a texture all through it."""

    waves: np.ndarray
    phases: np.ndarray
    contrast: float = 25.0

    @staticmethod
    def draw(rng: np.random.Generator, *, shortest=0.014, longest=0.08, contrast=25.0) -> "Ball":
        length = np.exp(rng.uniform(np.log(shortest), np.log(longest), WAVES))
        direction = rng.normal(0, 1, (WAVES, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return Ball(2 * np.pi / length[:, None] * direction, rng.uniform(0, 2 * np.pi, WAVES), contrast)

    def flat(self) -> "Ball":
        return replace(self, contrast=0.0)

    def filmed(self, camera: Camera, rng: np.random.Generator, *, noise=1.0) -> np.ndarray:
        """(H, W, 3) what the camera sees, noisy and rounded; the room behind the ball is grey."""
        width, height = camera.size
        y, x = np.mgrid[0:height, 0:width]
        rays = camera.rays(np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)).directions
        along = -rays @ camera.centre
        square = along**2 - camera.centre @ camera.centre + RADIUS**2
        on_ball = square > 0
        place = camera.centre + (along - np.sqrt(np.maximum(square, 0)))[on_ball, None] * rays[on_ball]
        texture = np.zeros(len(place))
        for wave, phase in zip(self.waves, self.phases, strict=True):
            texture += np.cos(place @ wave + phase)
        grey = np.full(len(rays), GROUND)
        grey[on_ball] = 120 + self.contrast * np.sqrt(2 / len(self.phases)) * texture
        grey = grey.reshape(height, width) + rng.normal(0, noise, (height, width))
        return np.repeat(np.clip(np.round(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def films(rig: Rig, rng: np.random.Generator, *, noise=1.0, **texture) -> list[np.ndarray]:
    ball = Ball.draw(rng, **texture)
    return [ball.filmed(camera, rng, noise=noise) for camera in rig]


def beside_ball(points: np.ndarray) -> np.ndarray:
    """How far points (n, 3) lie outside of the ball [m]."""
    return np.linalg.norm(points, axis=1) - RADIUS
