"""Measured surface: points and trajectories of a rendered arm, along the normal of its true surface.

Frames 20 to 31 of `arm3`, a point every 6 px; the same as a careless user films them: at half the size, each image
stored as JPEG of quality 50. Only the distance along the normal has a truth: where on the surface a point belongs is
not known.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.common.program import surface
from bench.intervals.scoring import Sample, single
from bench.recording import Run
from bench.surface.arm import WAYS
from marey.io.shapes.measured_surface import read_surface
from marey.io.shapes.trajectories import read_trajectories

FRAMES = range(20, 32)
COMPARED = (21, 25, 29)
"""Frames whose points are compared with the truth; trajectories are compared in all."""
SPACING = {"default": 6, "careless": 3}
"""Pixels from point to point: the same distance on the arm."""
NAMES = {"default": "as rendered", "careless": "half size, JPEG"}


def samples(run: Run) -> Iterator[Sample]:
    """Measure and track the surface of both films."""
    trial = run.shared / "data" / "people" / "arm3"
    with np.load(trial / "truth" / "truth.npz") as file:
        vertices, faces = file["vertices"].astype(float), file["faces"]
    for way, spacing in SPACING.items():
        folder, _ = WAYS[way](trial, run.out / "intervals" / "arm")
        out = surface(folder, run.out / "intervals" / "arm" / way, frames=FRAMES, spacing=spacing)
        yield from of_points(run, NAMES[way], out, vertices, faces)
        yield from of_tracks(run, NAMES[way], out, vertices, faces)


def of_points(run: Run, film: str, out: Path, vertices: np.ndarray, faces: np.ndarray) -> Iterator[Sample]:
    """Compare measured points, each frame a case."""
    points = read_surface(out / "surface.npz")
    for frame in COMPARED:
        own = points.of_frame(frame)
        yield along_normal(
            run, "points along the normal", f"{film}, {frame}", own.points, own.covariance, vertices[frame], faces
        )


def of_tracks(run: Run, film: str, out: Path, vertices: np.ndarray, faces: np.ndarray) -> Iterator[Sample]:
    """Compare the trajectories, each frame a case."""
    tracks = read_trajectories(out / "trajectories.npz")
    for row, frame in enumerate(tracks.frames):
        here = tracks.kept[np.isfinite(tracks.position[row, tracks.kept, 0])]
        position, spread = (np.asarray(each[row, here], float) for each in (tracks.position, tracks.covariance))
        if len(here):
            yield along_normal(
                run, "trajectories along the normal", f"{film}, {frame}", position, spread, vertices[frame], faces
            )


def along_normal(
    run: Run, quantity: str, case: str, points: np.ndarray, covariance: np.ndarray, vertices: np.ndarray,
    faces: np.ndarray,
) -> Sample:  # fmt: skip
    """Compare the distances of points (n, 3) from the true surface along its normal with their covariance."""
    sys.path.insert(0, str(run.shared / "score"))
    from surface import nearest_on_faces

    which, weights, _ = nearest_on_faces(points, vertices, faces)
    corner = vertices[faces[which]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off = np.einsum("nc,nc->n", points - np.einsum("nk,nkc->nc", weights, corner), normal)
    sd = np.sqrt(np.einsum("ni,nij,nj->n", normal, covariance, normal))
    return single(quantity, case, "mm", 1e3 * off, 1e3 * sd)
