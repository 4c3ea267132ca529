"""Shapes before one camera whose scale changes, on made takes: `python bench/scaled_orthographic.py`.

A body that deforms in two ways turns before a camera and comes and goes, which changes its scale by the given standard
deviation of its logarithm; 25 points, 80 frames, noise of 0.5 % of the body's size. Printed are the error of the shapes
before the camera as a share of their size (the better mirror image, one scale for all), at one scale and with the
scale free, the error of the magnification (standard deviation of its logarithm), and that of a rigid start.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.shape_errors import shape_error

from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.many_cameras.scaled_orthographic import factorise_scaled, rigid_magnifications
from marey.nonrigid.one_camera.one_view import factorise_tracks

FRAMES, POINTS, NOISE = 80, 25, 0.005
SEEDS = (0, 1, 2)


def main() -> None:
    print("departure, swing, seed: error at one scale, error with free scale; magnification off by, by the rigid start")
    for departure, swing in ((0.15, 0.0), (0.15, 0.2), (0.15, 0.4), (0.3, 0.2)):
        for seed in SEEDS:
            placed, size, tracks = made_take(seed, departure, swing)
            free = factorise_scaled(tracks)
            start = rigid_magnifications(tracks - tracks.mean(2, keepdims=True))
            off, at_first = (float(np.std(np.log(s / size))) for s in (free.magnification, start))
            errors = [
                shape_error(found.rotation @ found.shape, placed) for found in (factorise_tracks(tracks), free.shapes)
            ]
            print(f"{departure} {swing} {seed}: {errors[0]:.3f} {errors[1]:.3f}; {off:.3f} {at_first:.3f}", flush=True)


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


if __name__ == "__main__":
    main()
