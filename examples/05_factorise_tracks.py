"""Recover the moving 3-D shape of a deforming surface from the tracks of one camera.

    python examples/05_factorise_tracks.py [TRACKS] [--out shapes]

Input: tracks of points in a video, NPZ with `tracks` (F, 2, P) in pixels; by default a bending sheet that this example
makes, whose true shape is known.
Output: the files of `marey nonrigid` in the folder OUT.
Features: `marey.read_tracks`, `marey.factorise`, `Shapes.to_xarray`, `Shapes.save`.
"""

import argparse
from pathlib import Path

import numpy as np

import marey

FRAMES, ROWS = 60, 6


def bending_sheet() -> tuple[np.ndarray, np.ndarray]:
    """Make the tracks (F, 2, P) [px] of a sheet that bends while it turns, and its true shapes (F, 3, P)."""
    rng = np.random.default_rng(0)
    time = np.arange(FRAMES) / 30
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, ROWS), np.linspace(-1, 1, ROWS)))
    bend = 0.8 + 0.3 * np.sin(2 * np.pi * 0.8 * time)
    shape = np.stack(
        [np.broadcast_to(u, (FRAMES, u.size)), np.broadcast_to(v, (FRAMES, u.size)), bend[:, None] * u**2], 1
    )
    turn, nod = 2.1 * time, 0.5 * np.sin(3 * time)
    about_y = np.stack([np.cos(turn), 0 * turn, np.sin(turn), 0 * turn, 1 + 0 * turn, 0 * turn], 1).reshape(-1, 2, 3)
    about_x = np.stack([1 + 0 * nod, 0 * nod, 0 * nod, 0 * nod, np.cos(nod), -np.sin(nod),
                        0 * nod, np.sin(nod), np.cos(nod)], 1).reshape(-1, 3, 3)  # fmt: skip
    tracks = 200 * (about_y @ about_x @ shape) + 320 + rng.normal(0, 0.2, (FRAMES, 2, u.size))
    return tracks, shape


def error_percent(found: np.ndarray, true: np.ndarray) -> float:
    """Return the RMS error of shapes (F, 3, P) after alignment per frame, as a percentage of the size of the object.

    One camera leaves open the scale and a mirror image in depth; both are chosen in favour of the result.
    """
    best = np.inf
    for mirror in (1.0, -1.0):
        error = size = 0.0
        for a, b in zip(found * [[1.0], [1.0], [mirror]], true, strict=True):
            a, b = a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)
            left, values, right = np.linalg.svd(b @ a.T)
            sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
            scale = (values * sign).sum() / (a**2).sum()
            error += ((scale * (left * sign) @ right @ a - b) ** 2).sum()
            size += (b**2).sum()
        best = min(best, float(100 * np.sqrt(error / size)))
    return best


def main(arguments: list[str] | None = None) -> marey.Shapes:
    """Factorise the tracks, and compare with the truth where it is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tracks", nargs="?", type=Path, default=None)
    parser.add_argument("--out", type=Path, default=Path("shapes"))
    given = parser.parse_args(arguments)

    tracks, truth = bending_sheet() if given.tracks is None else (marey.read_tracks(given.tracks), None)
    with marey.tuned_process(parallel_cameras=False):
        shapes = marey.factorise(tracks, rate=30.0)
    print(shapes)
    if truth is not None:
        print(f"Error of the shape: {error_percent(shapes.shape, truth):.2f} % of the size of the sheet")
    print(shapes.to_xarray())
    print(f"Files: {shapes.save(given.out)}")
    return shapes


if __name__ == "__main__":
    main()
