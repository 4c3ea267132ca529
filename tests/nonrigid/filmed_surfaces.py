"""A synthetic surface that rotates and bends before orthographic cameras, for the tests of several views."""

import numpy as np

from marey.geometry import rotations


def moving_surface(random, frames=60, points=24, modes=2):
    """Give points (F, P, 3) that swing about two axes and bend."""
    mean = random.normal(size=(points, 3)) * (1.0, 0.8, 0.6)
    bends = 0.15 * random.normal(size=(modes, points, 3))
    t = np.arange(frames) / frames
    weights = np.sin(2 * np.pi * (t[:, None] * (1 + np.arange(modes)) + 0.2))
    turn = np.stack([0.5 * np.sin(5 * t), 0.6 * np.sin(7 * t + 1), 0.3 * t], -1)
    shape = mean + np.einsum("fm,mpi->fpi", weights, bends)
    return np.einsum("fij,fpj->fpi", rotations.exp(turn), shape) + np.stack([3 * t, t**2, 0 * t], -1)[:, None]


def filmed(points, camera, *, scale=1.0, noise=0.0, random=None):
    """Give the tracks (F, 2, P) before an orthographic camera turned by a rotation vector."""
    tracks = scale * np.einsum("ij,fpj->fip", rotations.exp(np.asarray(camera, float))[:2], points)
    return tracks if random is None else tracks + noise * random.normal(size=tracks.shape)


CAMERAS = ((0.1, 0.0, 0.3), (-0.1, 0.8, 0.0), (0.9, -0.2, 0.4))
