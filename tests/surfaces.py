"""Measured points for tests."""

import numpy as np

from marey.surface.points.measured import MeasuredPoints

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
