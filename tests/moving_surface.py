"""A textured plane that moves before cameras, exact in every pixel; another one may hide it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from marey.cameras.camera import Camera
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.surface.points.measured import MeasuredPoints
from tests.textures import Texture
from tests.worlds import looking_at

SIZE, FOCAL = (150, 120), 300.0
PIXEL_M = 1 / FOCAL
"""What a pixel shows at one metre [m]."""


def three_cameras(count: int = 3) -> tuple[Camera, ...]:
    """Cameras a metre before the origin, 12 degrees apart."""
    bearings = np.deg2rad(12) * (np.arange(count) - (count - 1) / 2)
    return tuple(
        looking_at(np.zeros(3), np.array([np.sin(b), -np.cos(b), 0.0]), name=f"cam{i + 1:02d}", size=SIZE, focal=FOCAL)
        for i, b in enumerate(bearings)
    )


def moving(frame: float, *, step=(0.008, 0.0, 0.004), turn=0.02) -> RigidTransform:
    """World from plane: some pixels and a degree or so a frame."""
    rotation = rotations.exp(turn * frame * np.array([0.3, 1.0, 0.5]))
    return RigidTransform(rotation, frame * np.array(step))


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A plane (its own x and z; y is its normal) and, where there is one, something before it."""

    texture: Texture
    world_from_plane: Callable[[float], RigidTransform] = moving
    noise: float = 1.0
    hidden: Callable[[float], tuple[float, float]] | None = None
    """For a frame the world's x between which a dark board hides the plane [m]."""

    def picture(self, camera: Camera, frame: float) -> np.ndarray:
        y, x = np.indices((camera.height, camera.width), float)
        rays = camera.rays(np.stack([x.ravel(), y.ravel()], axis=-1)).directions
        pose = self.world_from_plane(frame)
        normal = pose.rotation[:, 1]
        depth = ((pose.translation - camera.centre) @ normal) / (rays @ normal)
        world = camera.centre + depth[:, None] * rays
        own = (world - pose.translation) @ pose.rotation
        grey = self.texture(own[:, [0, 2]] / PIXEL_M)
        if self.hidden is not None:
            low, high = self.hidden(frame)
            # The board stands 5 cm before the origin.
            across = (camera.centre + ((-0.05 - camera.centre[1]) / rays[:, 1])[:, None] * rays)[:, 0]
            grey = np.where((across >= low) & (across <= high), 30.0, grey)
        rng = np.random.default_rng([int(frame), int(1e6 * (camera.centre[0] + 2))])
        grey = grey + rng.normal(0, self.noise, grey.shape)
        return np.clip(np.round(grey), 0, 255).astype(np.uint8).reshape(camera.height, camera.width)

    def frames(self, cameras: Sequence[Camera], numbers: Sequence[int]):
        for number in numbers:
            yield number, [self.picture(camera, number) for camera in cameras]

    def grid(self, step: float, *, half=(0.3, 0.24)) -> np.ndarray:
        """Places (n, 3) on the plane, in its own axes [m]."""
        x, z = np.meshgrid(np.arange(-half[0], half[0], step), np.arange(-half[1], half[1], step))
        return np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=-1)

    def seeds(self, cameras: Sequence[Camera], frame: int, *, step=0.012, error_px=0.1) -> MeasuredPoints:
        """What a dense measurement would have found, not quite exact."""
        rng = np.random.default_rng(frame)
        points = self.world_from_plane(frame).apply(self.grid(step))
        pixels = np.stack([camera.project(points) for camera in cameras], axis=1)
        inside = np.stack([c.sees(pixels[:, i], margin=12) for i, c in enumerate(cameras)], axis=1).all(axis=1)
        points, pixels = points[inside], pixels[inside] + rng.normal(0, error_px, pixels[inside].shape)
        count, views = pixels.shape[:2]
        correlation = np.full((count, views), 0.95)
        correlation[:, views // 2] = 1.0
        return MeasuredPoints(
            frame=np.full(count, frame), points=points, covariance=np.tile(1e-8 * np.eye(3), (count, 1, 1)),
            camera_names=tuple(c.name for c in cameras), pixels=pixels, correlation=correlation,
            residual_px=np.zeros(count), colour=np.zeros((count, 3)),
        )  # fmt: skip


def scene(seed: int = 5, **given) -> Scene:
    rng = np.random.default_rng(seed)
    return Scene(texture=Texture.draw(rng, count=40, shortest=6.0, longest=20.0), **given)
