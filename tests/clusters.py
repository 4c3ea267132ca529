"""A cluster that moves rigidly and changes its shape in a few modes, for tests."""

import numpy as np

from marey.geometry import rotations


def moving_cluster(
    rng: np.random.Generator, *, frames: int = 150, count: int = 6, skin_m: float = 0.005, noise_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (F, M, 3), rotation (F, 3, 3) and translation (F, 3): laboratory from cluster."""
    time = np.linspace(0, 1, frames)
    shape = rng.uniform(-0.1, 0.1, (count, 3))
    modes = rng.normal(size=(2, count, 3))
    parts = np.stack([np.sin(2 * np.pi * time), np.cos(6 * np.pi * time)], -1)
    turn = np.stack([np.sin(8 * np.pi * time), 0.3 * np.cos(4 * np.pi * time), 0.5 * time], -1)
    rotation = np.stack([rotations.exp(v) for v in turn])
    translation = np.stack([time, np.sin(8 * np.pi * time) * 0.2, 0.8 + 0 * time], -1)
    local = shape + skin_m * np.einsum("fk,kmi->fmi", parts, modes)
    points = np.einsum("fij,fmj->fmi", rotation, local) + translation[:, None]
    return points + noise_m * rng.normal(size=points.shape), rotation, translation
