"""Made MR volumes of a limb with gadolinium balls on its skin, fat dark or bright."""

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from marey.knee.space.volume import Volume, VoxelGrid

LEVELS = {
    "dark": {"air": 4.0, "fat": 18.0, "muscle": 60.0, "ball": 230.0},
    "bright": {"air": 4.0, "fat": 130.0, "muscle": 50.0, "ball": 165.0},
}
RADIUS_MM = 26.0
"""Of the limb, a cylinder along z."""


def limb_grid(spacing: tuple[float, float, float], *, turn: float = 0.2, length_mm: float = 36.0) -> VoxelGrid:
    """About 84 x 84 mm across the limb, turned a little about z; the first two axes point right and forward."""
    counts = np.ceil(np.array([84.0, 84.0, length_mm]) / spacing).astype(int)
    axes = np.array([[-np.cos(turn), np.sin(turn), 0], [-np.sin(turn), -np.cos(turn), 0], [0, 0, 1]])
    lps_from_voxel = np.eye(4)
    lps_from_voxel[:3, :3] = axes * spacing
    lps_from_voxel[:3, 3] = -lps_from_voxel[:3, :3] @ ((counts - 1) / 2)
    i, j, k = counts.tolist()
    return VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def on_skin(angle: float, height_mm: float, radius_mm: float, sunk: float = 0.5) -> list[float]:
    """Place a ball about the limb: 0 sunk touches the skin from outside, 0.5 is half in it."""
    away = RADIUS_MM + radius_mm * (1 - 2 * sunk)
    return [away * np.cos(angle), away * np.sin(angle), height_mm]


def limb_with_balls(
    grid: VoxelGrid, centres: ArrayLike, radii: ArrayLike, kind: str, *, noise: float = 4.0, bias: float = 0.0,
    blur_mm: float = 0.0, seed: int = 0,
) -> Volume:  # fmt: skip
    """A limb of muscle under fat; a ball's voxels are the mean of many points; noise as in a magnitude image."""
    level = LEVELS[kind]
    k, j, i = np.meshgrid(*[np.arange(n, dtype=float) for n in grid.shape], indexing="ij")
    place = grid.lps(np.stack([i, j, k], axis=-1))
    angle = np.arctan2(place[..., 1], place[..., 0])
    # The skin waves a little, so that no plane and no cylinder has its shape.
    depth = RADIUS_MM - np.hypot(place[..., 0], place[..., 1]) + 0.6 * np.sin(5 * angle + place[..., 2] / 9)
    soft = float(grid.spacing_mm[0])
    image = level["air"] + (level["fat"] - level["air"]) * np.clip(depth / soft + 0.5, 0, 1)
    muscle = np.clip((depth - 7 - 2 * np.sin(3 * angle)) / soft + 0.5, 0, 1)
    image += (level["muscle"] - level["fat"]) * muscle
    for centre, radius in zip(np.reshape(centres, (-1, 3)), np.ravel(radii), strict=True):
        box, share = _ball(grid, np.asarray(centre, float), float(radius))
        image[box] += share * (level["ball"] - image[box])
    if blur_mm:
        image = ndimage.gaussian_filter(image, [blur_mm / each for each in grid.array_spacing_mm])
    image *= 1 + bias * (place[..., 0] / 60 - 0.5 * place[..., 2] / 40)
    random = np.random.default_rng(seed)
    parts = image + random.normal(0, noise, image.shape), random.normal(0, noise, image.shape)
    return Volume(intensity=np.hypot(*parts), grid=grid)


def _ball(grid: VoxelGrid, centre: np.ndarray, radius: float) -> tuple[tuple[slice, ...], np.ndarray]:
    """The box of voxels about a ball, and which share of each it fills."""
    middle, half = grid.voxels(centre), radius / grid.spacing_mm + 1
    low = np.clip(np.floor(middle - half).astype(int), 0, grid.shape[::-1])[::-1].tolist()
    high = np.clip(np.ceil(middle + half).astype(int) + 1, 0, grid.shape[::-1])[::-1].tolist()
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    k, j, i = np.meshgrid(*[np.arange(a, b, dtype=float) for a, b in zip(low, high, strict=True)], indexing="ij")
    voxels = np.stack([i, j, k], axis=-1)
    counts = np.maximum(np.ceil(grid.spacing_mm / 0.2), 2).astype(int)
    axes = [(np.arange(n) + 0.5) / n - 0.5 for n in counts]
    share = np.zeros(voxels.shape[:3])
    for step in np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3):
        share += ((grid.lps(voxels + step) - centre) ** 2).sum(axis=-1) < radius**2
    return box, share / counts.prod()
