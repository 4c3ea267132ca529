"""From three videos of a moving arm, with unknown cameras, to its surface in space.

The videos are data/people/arm3 without its cameras.toml: points are chosen in a piece of the first camera's first
image, followed, found in the other cameras, and factorised at held size. Truth: the surface's points seen at the
chosen pixels, carried along by the true mesh. Every frame is centred (orthographic cameras do not determine the
distance), then ONE similarity is fitted for all frames and points together. Errors are root mean squares per point
and frame of places that two cameras see, also in % of the piece's size (the largest distance between two of its
points in the first frame). *Rigid*: the first frame's recovered shape moved rigidly ([Spoor1980]).
"""

import argparse
import time
from typing import NamedTuple

import cv2
import numpy as np

from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.arrays import Floats, Mask
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.io.calibration.readers import read_rig
from marey.io.video.video import open_clip
from marey.nonrigid.core.alignment import rigid_fits
from marey.nonrigid.correspondence.uncalibrated_videos import ViewTracks, track_views
from marey.nonrigid.many_cameras.held_size import HeldSizeShapes, factorise_at_held_size
from marey.nonrigid.many_cameras.many_views import ManyViewShapes

BENCH = Bench(
    measures="Surface of an arm in space from three videos of unknown cameras, against the true surface.",
    sources=("src/marey/nonrigid", "src/marey/images", "src/marey/geometry"),
    minutes=4,
)
PIECES = {
    "elbow": ((560, 250), (640, 290), (590, 400), (500, 520), (440, 480), (500, 380)),
    "sleeve": ((585, 200), (650, 250), (580, 390), (515, 365)),
    "forearm": ((505, 395), (565, 430), (480, 560), (420, 520)),
}
"""Corners of pieces of the first camera's first image [px]."""
RANKS = range(1, 6)
FEWEST = 6
"""Points that two cameras must see in an evaluated frame, and frames in which a point must be seen."""


class Surface(NamedTuple):
    """Points of the true surface."""

    corners: Floats
    """(P, 3) numbers of the vertices."""
    weights: Floats
    """(P, 3)."""
    vertices: Floats
    """(F, V, 3) m, world."""

    def points(self) -> Floats:
        """Return them (F, P, 3) [m]; NaN where the mesh is in no image, or where no surface was hit."""
        return np.einsum("pk,fpki->fpi", self.weights, self.vertices[:, self.corners])


def surface_at(rig: Rig, pixels: Floats, vertices: Floats, faces: np.ndarray) -> Surface:
    """Find the points of the mesh that the first camera sees at pixels of the first frame."""
    camera = rig.cameras[0]
    flat, depth = camera.project(vertices[0]), camera.depths(vertices[0])
    triangle = flat[faces]
    low, high = triangle.min(axis=1), triangle.max(axis=1)
    corners, weights = np.zeros((len(pixels), 3), np.int64), np.full((len(pixels), 3), np.nan)
    for number, pixel in enumerate(pixels):
        nearest = np.inf
        for face in np.flatnonzero(np.all((low <= pixel) & (high >= pixel), axis=1)):
            a, b, c = triangle[face]
            share = np.linalg.solve(np.stack([b - a, c - a], axis=1), pixel - a)
            flat_weights = np.array([1 - share.sum(), *share])
            # Straight lines stay straight in an image, but equal steps do not stay equal: perspective weights.
            closeness = flat_weights / depth[faces[face]]
            if flat_weights.min() >= 0 and 1 / closeness.sum() < nearest:
                nearest = 1 / closeness.sum()
                corners[number], weights[number] = faces[face], closeness / closeness.sum()
    return Surface(corners, weights, vertices)


def judged(found: ViewTracks) -> tuple[Mask, Mask]:
    """Which frames (F,) and points (P,) have enough data."""
    seen = np.isfinite(found.tracks[:, :, 0])
    frames = (seen.sum(axis=2) >= FEWEST).sum(axis=0) >= 2
    return frames, np.asarray(seen[:, frames].any(axis=0).sum(axis=0) >= FEWEST)


def error(shape: Floats, truth: Floats, seen: Mask) -> float:
    """The root mean square distance [mm] after centring each frame and one similarity for all.

    Args:
        shape: (F, P, 3) in the first camera's axes, any unit.
        truth: (F, P, 3) [m].
        seen: (F, P) what is evaluated.
    """
    known = seen & np.isfinite(truth).all(axis=2)
    a, b = (centred(points, known)[known] for points in (shape, truth))
    u, d, vt = np.linalg.svd(b.T @ a)
    away = b - a @ (u @ vt).T * (d.sum() / np.sum(a**2))
    return float(1e3 * np.sqrt(np.mean(np.sum(away**2, axis=1))))


def centred(points: Floats, known: Mask) -> Floats:
    middle = np.where(known[..., None], np.nan_to_num(points), 0).sum(axis=1) / known.sum(axis=1)[:, None]
    return points - middle[:, None]


def in_camera(shapes: ManyViewShapes, count: int | None = None) -> Floats:
    """Return shapes (F, P, 3) in the first camera's axes, of the first `count` basis shapes or of all."""
    shape = np.einsum("fk,kip->fip", shapes.coefficients[:, :count], shapes.basis[:count])
    return np.einsum("fij,fjp->fpi", shapes.rotation, shape)


def rigid(shape: Floats) -> Floats:
    """Move the first frame's shape (F, P, 3) rigidly, as Spoor and Veldpaus, to fit each frame's."""
    rotation, translation = rigid_fits(shape[0], shape, np.ones(shape.shape[:2], bool))
    return np.einsum("fij,pj->fpi", rotation, shape[0]) + translation[:, None]


def track_rows(table: Table, name: str, rig: Rig, found: ViewTracks, truth: Floats) -> None:
    """How far tracks lie from the true surface's points."""
    for number, camera in enumerate(rig.cameras):
        pixels = camera.project(truth.reshape(-1, 3)).reshape(*truth.shape[:2], 2)
        away = np.linalg.norm(found.tracks[number] - np.swapaxes(pixels, 1, 2), axis=1)
        start = away[found.start]
        points = int(np.isfinite(found.probability[number]).sum())
        table.row(
            (name, rig.names[number]), points, int((start > 3).sum()), np.nanmedian(away), np.nanquantile(away, 0.95)
        )


def camera_rows(table: Table, name: str, rig: Rig, shapes: ManyViewShapes) -> None:
    """Angles from the first camera."""
    first = rig.cameras[0].camera_from_world.rotation
    for number in range(1, len(shapes.scale)):
        true = rig.cameras[number].camera_from_world.rotation @ first.T
        angles = [np.degrees(np.linalg.norm(rotations.log(r))) for r in (shapes.camera_from_first[number], true)]
        table.row((name, rig.names[number]), *angles)


def error_rows(table: Table, name: str, held: HeldSizeShapes, tracks: Floats, truth: Floats) -> None:
    """Errors by the number of basis shapes."""
    cameras = np.isfinite(tracks[:, :, 0]).sum(axis=0)
    first = truth[0][np.isfinite(truth[0]).all(axis=1)]
    size = 1e3 * float(np.max(np.linalg.norm(first[:, None] - first, axis=2)))
    shapes, count = held.shapes, f"{tracks.shape[3]} points, {tracks.shape[1]} frames, {size:.0f} mm"
    rows = {
        "rigid": rigid(in_camera(shapes)),
        **{f"K = {rank}": in_camera(shapes, rank) for rank in RANKS if rank <= shapes.rank},
        f"chosen, K = {shapes.rank}": in_camera(shapes),
    }
    for label, shape in rows.items():
        away = error(shape, truth, cameras >= 2)
        table.row((f"{name} ({count})", label), away, 100 * away / size)
    away = error(in_camera(shapes), truth, cameras >= 1)
    lonely = 100 * float(np.mean(cameras[cameras >= 1] == 1))
    table.row(
        (f"{name} ({count})", f"chosen, with the {lonely:.0f} % of places that one camera sees"),
        away,
        100 * away / size,
    )


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("pieces", nargs="*", help=f"of {', '.join(PIECES)}; all without any")


def run(run: Run) -> None:
    """Follow, factorise, and compare."""
    errors = run.table("Errors", ("piece", "shapes"), Column("error", "mm", 2), Column("of the size", "%", 2))
    followed = run.table(
        "Tracks",
        ("piece", "camera"),
        Column("points"),
        Column("wrong (3 px off at first)"),
        Column("off, median", "px", 2),
        Column("95 %", "px", 2),
    )
    cameras = run.table(
        "Angles from the first camera", ("piece", "camera"), Column("found", "deg", 1), Column("true", "deg", 1)
    )
    trial = run.shared / "data" / "people" / "arm3"
    clips = [open_clip(trial / f"cam0{number}.mp4") for number in (1, 2, 3)]
    videos = [[cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in clip.images(range(clip.count))] for clip in clips]
    rig = read_rig(trial / "cameras.toml")
    with np.load(trial / "truth" / "truth.npz") as file:
        vertices, faces = file["vertices"].astype(float), file["faces"]
    for name in run.arguments.pieces or PIECES:
        within = np.zeros(videos[0][0].shape, np.uint8)
        cv2.fillPoly(within, [np.array(PIECES[name])], (1,))
        started = time.perf_counter()
        found = track_views(videos, within=within > 0)
        middle = time.perf_counter()
        frames, points = judged(found)
        tracks = found.tracks[found.connected][:, frames][..., points]
        held = factorise_at_held_size(tracks)
        run.report(f"following and matching {middle - started:.0f} s, shapes {time.perf_counter() - middle:.0f} s")
        truth = surface_at(rig, found.tracks[0, 0].T, vertices, faces).points()
        kept = rig.subset([camera for camera, connected in zip(rig.names, found.connected, strict=True) if connected])
        error_rows(errors, name, held, tracks, truth[frames][:, points])
        track_rows(followed, name, rig, found, truth)
        camera_rows(cameras, name, kept, held.shapes)
