"""The measured surface of a moving arm against its true one, and of the same clip as a careless user films it.

`as-given` measures every third pixel. `careless` is the same clip at half the size, each image stored as JPEG of
quality 50; the cameras are scaled. `default` is `marey surface` with its defaults: every second pixel, and tracked.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from bench.common.program import score, surface
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.io.calibration.readers import write_cameras_toml
from marey.io.shapes.measured_surface import read_surface
from marey.io.trial.trial import read_trial

BENCH = Bench(
    measures="Distance of the measured surface and its trajectories from the true surface of a rendered arm (arm3).",
    sources=("src/marey/cameras", "src/marey/images", "src/marey/surface", "src/marey/pipelines/surface"),
    minutes=15,
)

SURFACE = (
    Column("points"), Column("median", "mm", 2), Column("95 % below", "mm", 2), Column("farther than 10 mm", "", 3),
    Column("covered", "", 2),
)  # fmt: skip
SURFACE_KEYS = ("points", "median_mm", "p95_mm", "far", "covered")
TRACKS = (Column("trajectories"), Column("frames, mean", "", 1), Column("drift", "mm", 2), Column("strayed", "", 3))
TRACKS_KEYS = ("trajectories", "frames", "drift_mm", "strayed")
RATIOS = (Column("ratio of medians", "", 2), Column("within 1 sd", "%", 0), Column("within 1.96 sd", "%", 0))
"""Columns of `in_stated_sd`."""
NOTE = (
    "Distances from the true surface. *Covered*: share of the vertices that all three cameras see with a point "
    "within 3 mm. "
    "*Drift*: distance, in a trajectory's last frame, from the place of the surface where it began, median. "
    "*Strayed*: share of "
    "trajectories that are ever more than 10 mm from that place."
)
QUALITY = 50
FACTOR = 0.5


def as_given(trial: Path, out: Path) -> tuple[Path, int]:
    return trial, 3


def careless(trial: Path, out: Path) -> tuple[Path, int]:
    folder, given = out / "careless_trial", read_trial(trial)
    (folder / "background").mkdir(parents=True, exist_ok=True)
    write_cameras_toml(given.rig.scaled(FACTOR), folder / "cameras.toml")
    (folder / "trial.toml").write_text(f"rate = {given.take.rate}\n")
    for name, clip in given.background.items():
        write(folder / "background" / f"{name}.jpg", clip.image(0))
    for frame, images in given.take.frames():
        for name, image in zip(given.rig.names, images, strict=True):
            write(folder / f"{name}_{frame:03d}.jpg", image)
    return folder, 2


def write(path: Path, image) -> None:
    small = cv2.resize(image, None, fx=FACTOR, fy=FACTOR, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def default(trial: Path, out: Path) -> tuple[Path, int]:
    return trial, 2


WAYS: dict[str, Callable[[Path, Path], tuple[Path, int]]] = {
    "as-given": as_given, "careless": careless, "default": default
}  # fmt: skip
FRAMES = (10, 35, 60)
"""Frames in which errors are compared with their standard deviations."""


def stated(run: Run, table: Table, name: str, result: Path, truth: Path) -> None:
    """Compare distances along the true surface's normal with the standard deviations stated for that direction."""
    points = read_surface(result)
    with np.load(truth) as file:
        vertices, faces = file["vertices"].astype(float), file["faces"]
    for frame in FRAMES:
        own = points.of_frame(frame)
        table.row((name, str(frame)), *in_stated_sd(run.shared, own.points, own.covariance, vertices[frame], faces))


def in_stated_sd(
    shared: Path, points: np.ndarray, covariance: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> list[float]:
    """Compare distances (n,) of points from the true surface along its normal with their standard deviations.

    Returns:
        Ratio of the medians, and the shares within 1 and 1.96 standard deviations [%].
    """
    sys.path.insert(0, str(shared / "score"))
    from surface import nearest_on_faces

    which, weights, _ = nearest_on_faces(points, vertices, faces)
    corner = vertices[faces[which]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off = np.einsum("nc,nc->n", points - np.einsum("nk,nkc->nc", weights, corner), normal)
    ratio = np.abs(off) / np.sqrt(np.einsum("ni,nij,nj->n", normal, covariance, normal))
    return [float(np.median(ratio) / 0.6745), *(float(100 * np.mean(ratio < limit)) for limit in (1, 1.96))]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("ways", nargs="*", help=f"{', '.join(WAYS)}; all without any")


def run(run: Run) -> None:
    """Measure, and score."""
    trial = run.shared / "data" / "people" / "arm3"
    truth = trial / "truth" / "truth.npz"
    points = run.table("Points", ("film", "spacing [px]"), *SURFACE, note=NOTE)
    tracks = run.table("Trajectories", "film", *TRACKS)
    ratios = run.table(
        "Distances along the normal beside their stated standard deviations", ("film", "frame"), *RATIOS
    )  # fmt: skip
    for name in run.arguments.ways or WAYS:
        folder, spacing = WAYS[name](trial, run.out / "arm")
        found = surface(folder, run.out / "arm" / name, spacing=spacing, tracks=name == "default")
        points.row(
            (name, str(spacing)), *values_of(SURFACE_KEYS, score(run, "surface.py", found / "surface.npz", truth))
        )
        stated(run, ratios, name, found / "surface.npz", truth)
        if name == "default":
            scores = score(run, "surface.py", "--tracks", found / "trajectories.npz", truth)
            tracks.row(name, *values_of(TRACKS_KEYS, scores))


def values_of(keys: tuple[str, ...], scores: dict) -> list[float | None]:
    """The scores of some names."""
    return [scores.get(key) for key in keys]
