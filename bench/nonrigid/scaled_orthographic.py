"""Shapes before one orthographic camera whose scale changes, on made takes.

A body that deforms in two ways turns before a camera and comes and goes, which changes its scale by the given
standard deviation of its logarithm; 25 points, 80 frames, noise of 0.5 % of the body's size. Errors are those of the
shapes before the camera as a share of their size (the better mirror image, one scale for all).
"""

import numpy as np
from tests.shape_errors import shape_error

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.many_cameras.scaled_orthographic import factorise_scaled, rigid_magnifications
from marey.nonrigid.one_camera.one_view import factorise_tracks

BENCH = Bench(
    measures="Shapes with and without free magnification before a camera of changing scale, against made truth.",
    sources=("src/marey/nonrigid", "src/marey/geometry"),
    minutes=3,
    data=False,
)

FRAMES, POINTS, NOISE = 80, 25, 0.005
SEEDS = (0, 1, 2)


def run(run: Run) -> None:
    """Factorise made takes with one scale and with the scale free."""
    table = run.table(
        "Changing scale",
        ("departure from the mean shape", "sd of log scale", "seed"),
        Column("error at one scale", "", 3),
        Column("error with free scale", "", 3),
        Column("magnification off by", "", 3),
        Column("by the rigid start", "", 3),
    )
    for departure, swing in ((0.15, 0.0), (0.15, 0.2), (0.15, 0.4), (0.3, 0.2)):
        for seed in SEEDS:
            placed, size, tracks = made_take(seed, departure, swing)
            free = factorise_scaled(tracks)
            start = rigid_magnifications(tracks - tracks.mean(2, keepdims=True))
            off, at_first = (float(np.std(np.log(s / size))) for s in (free.magnification, start))
            errors = [
                shape_error(found.rotation @ found.shape, placed) for found in (factorise_tracks(tracks), free.shapes)
            ]
            table.row((str(departure), str(swing), str(seed)), *errors, off, at_first)


def made_take(seed: int, departure: float, swing: float) -> tuple[Floats, Floats, Floats]:
    """Make shapes before the camera (F, 3, P), magnifications (F,) and tracks (F, 2, P)."""
    rng = np.random.default_rng(seed)
    mean, modes = rng.normal(size=(3, POINTS)), rng.normal(size=(2, 3, POINTS))
    time = np.linspace(0, 1, FRAMES)
    turn = rotations.exp(np.stack([0.7 * np.sin(5 * time), 2.5 * time, 0.3 * np.cos(4 * time)], 1))
    weights = departure * np.stack([np.sin(7 * time), np.sin(11 * time + 1)], 1)
    placed = turn @ (mean + np.einsum("fm,mip->fip", weights, modes))
    size = np.exp(np.sqrt(2) * swing * np.sin(6 * time + seed))
    size /= np.exp(np.log(size).mean())
    shift, noise = rng.normal(size=(FRAMES, 2, 1)), NOISE * rng.normal(size=(FRAMES, 2, POINTS))
    return placed, size, size[:, None, None] * placed[:, :2] + shift + noise
