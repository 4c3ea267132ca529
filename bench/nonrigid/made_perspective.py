"""Made sequences before a perspective camera: sheets that bend, stretch, bodies that deform, and recorded people."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations

FRAMES = 120
KINDS = ("sheet", "rubber", "body", "rigid")


def bending_sheet(rng: np.random.Generator, frames: int = FRAMES, columns: int = 9, rows: int = 8) -> Floats:
    """Bend a sheet without stretching it, about an axis that wanders: curves of constant length (F, 3, P)."""
    u, v = (side.ravel() for side in np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-0.8, 0.8, rows)))
    time = np.arange(frames) / frames
    along = rng.uniform(0, np.pi) + 0.8 * np.sin(2 * np.pi * (time + rng.random()))
    first = 1.4 * np.sin(2 * np.pi * (1.3 * time + rng.random()))
    second = 0.8 * np.sin(2 * np.pi * (2.1 * time + rng.random()))
    shapes = np.zeros((frames, 3, u.size))
    for f in range(frames):
        across = np.cos(along[f]) * u + np.sin(along[f]) * v
        beside = -np.sin(along[f]) * u + np.cos(along[f]) * v
        steps = np.linspace(-1.4, 1.4, 2801)
        angle = first[f] * steps + second[f] * (steps**2 - 0.3)
        place = np.stack([np.cos(angle), np.sin(angle)]).cumsum(1) * (steps[1] - steps[0])
        place -= place[:, 1400:1401]
        x, z = (np.interp(across, steps, side) for side in place)
        shapes[f] = (
            np.cos(along[f]) * x - np.sin(along[f]) * beside,
            np.sin(along[f]) * x + np.cos(along[f]) * beside,
            z,
        )
    return shapes


def rubber_sheet(rng: np.random.Generator, frames: int = FRAMES) -> Floats:
    """Let a sheet bulge and stretch by up to a fifth."""
    u, v = (side.ravel() for side in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-0.8, 0.8, 8)))
    time = np.arange(frames) / frames
    waves = np.sin(2 * np.pi * (np.outer(time, [1.1, 1.7, 2.3, 0.9]) + rng.random(4)))
    shapes = np.zeros((frames, 3, u.size))
    bulge, ripple = np.exp(-(u**2 + v**2) / 0.5), np.sin(2 * u + v)
    shapes[:, 0] = u * (1 + 0.2 * waves[:, 2:3])
    shapes[:, 1] = v * (1 + 0.15 * waves[:, 3:])
    shapes[:, 2] = 0.45 * waves[:, :1] * bulge + 0.2 * waves[:, 1:2] * ripple
    return shapes


def deforming_body(rng: np.random.Generator, frames: int = FRAMES, points: int = 50, modes: int = 3) -> Floats:
    """Take points of an ellipsoid with smooth displacements, a third of whose size the neighbours share."""
    mean = rng.normal(size=(3, points))
    mean *= np.array([1.0, 0.7, 0.5])[:, None] / np.linalg.norm(mean, axis=0)
    distance = np.linalg.norm(mean[:, :, None] - mean[:, None], axis=0)
    kernel = np.linalg.cholesky(np.exp(-(distance**2) / 0.8) + 1e-6 * np.eye(points))
    displacements = rng.normal(size=(modes, 3, points)) @ kernel.T
    time = np.arange(frames) / frames
    weights = 0.06 * np.sin(2 * np.pi * (np.outer(time, rng.uniform(0.7, 3, modes)) + rng.random(modes)))
    return mean + np.einsum("fm,mip->fip", weights, displacements)


def recorded(shared: Path, name: str, frames: int = 150) -> Floats:
    """Return recorded people or a face, every second frame, the mean size 1."""
    with np.load(shared / "data" / "nonrigid" / f"{name}.npz") as data:
        shapes = np.asarray(data["shape"], float)[: 2 * frames : 2]
    shapes = shapes - shapes.mean((0, 2))[:, None]
    return shapes / np.sqrt((shapes**2).sum(1).mean())


def turning(rng: np.random.Generator, frames: int, amount: float) -> Floats:
    """Turn to and fro, and partly round, about axes by chance; amount in radians."""
    time = np.arange(frames) / frames
    axes = rng.normal(size=(2, 3))
    waves = np.sin(2 * np.pi * (np.outer(time, [0.8, 1.7]) + rng.random(2))) * [1.0, 0.4]
    return rotations.exp(amount * waves @ (axes / np.linalg.norm(axes, axis=1)[:, None]))


def filmed(
    rng: np.random.Generator, shapes: Floats, turn: float, away: float, focal: float, noise: float, gaps: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Film shapes at a distance of `away` times their half extent.

    Returns:
        Tracks (F, 2, P) px with noise and gaps; the matrix; points before the camera (F, 3, P); rotation (F, 3, 3).
    """
    frames = len(shapes)
    rotation = turning(rng, frames, turn)
    half = np.abs(shapes).max()
    time = np.arange(frames) / frames
    path = 0.3 * half * np.sin(2 * np.pi * (np.outer(time, [0.9, 1.3, 0.7]) + rng.random(3)))
    path[:, 2] += away * half
    points = rotation @ shapes + path[:, :, None]
    matrix = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]])
    seen = matrix @ points
    tracks = seen[:, :2] / seen[:, 2:] + noise * rng.normal(size=points[:, :2].shape)
    for _ in range(int(gaps * points[:, 0].size / 10)):
        frame, point = rng.integers(frames), rng.integers(points.shape[2])
        tracks[frame : frame + 10, :, point] = np.nan
    return tracks, matrix, points, rotation


def hidden(rng: np.random.Generator, tracks: Floats, share: float, *, together: bool) -> Floats:
    """Hide places of tracks (F, 2, P), until so many more are missing.

    Args:
        rng: Chooses them.
        tracks: Some may be missing already.
        share: Of all places.
        together: A sixth of the points, neighbours, for 10 % of the frames, as things before the object do; else
            single points for ten frames.
    """
    tracks = tracks.copy()
    frames, _, points = tracks.shape
    most, length = np.isnan(tracks[:, 0]).mean() + share, max(1, frames // 10) if together else 10
    while np.isnan(tracks[:, 0]).mean() < most:
        frame, point = rng.integers(frames), rng.integers(points)
        away = np.linalg.norm(tracks[frame] - tracks[frame, :, point : point + 1], axis=0)
        if np.isfinite(away[point]):
            gone = np.argsort(away)[: max(1, points // 6)] if together else [point]
            tracks[np.ix_(np.arange(frame, min(frame + length, frames)), [0, 1], gone)] = np.nan
    return tracks
