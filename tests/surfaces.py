"""Measured points for tests."""

from collections.abc import Sequence

import numpy as np

from marey.surface.points.measured import MeasuredPoints, shapes

CAMERAS = ("left", "middle", "right")


def some_points(rng: np.random.Generator, frames: list[int]) -> MeasuredPoints:
    """Points that mean nothing; the first lacks its match in the last camera."""
    count = len(frames)
    root = rng.normal(0, 1e-4, (count, 3, 3))
    pixels, correlation = rng.uniform(0, 500, (count, 3, 2)), rng.uniform(0.8, 0.99, (count, 3))
    correlation[:, 1] = 1
    pixels[0, 2], correlation[0, 2] = np.nan, np.nan
    return MeasuredPoints(
        frame=np.array(frames), points=rng.normal(0, 1, (count, 3)), covariance=root @ root.transpose(0, 2, 1),
        camera_names=CAMERAS, pixels=pixels, correlation=correlation, residual_px=rng.uniform(0, 0.5, count),
        colour=rng.integers(0, 256, (count, 3)),
    )  # fmt: skip


def no_points(camera_names: Sequence[str]) -> MeasuredPoints:
    """Return a surface without points."""
    empty: dict[str, np.ndarray] = {name: np.zeros((0, *shape)) for name, shape in shapes(len(camera_names)).items()}
    return MeasuredPoints(camera_names=tuple(camera_names), **empty)
