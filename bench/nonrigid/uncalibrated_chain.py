"""From three videos of a moving arm, with nothing known of the cameras, to its surface in space: how far off it is.

    python bench/uncalibrated_chain.py SHARED [elbow | sleeve | forearm ...]

SHARED/data/people/arm3 without its cameras.toml: points are chosen in a piece of the first camera's first picture,
followed, found in the other cameras, and factorised at held size. Truth: the surface's points seen at the chosen
pixels, carried along by the true mesh. Every frame is centred (orthographic cameras do not tell the distance), then
ONE similarity is fitted for all frames and points together. Prints, in mm and in % of the piece's size (the largest
distance between two of its points in the first frame), the root mean square error a point and frame for the first K
basis shapes, for all that were chosen, and for the rigid motion of Spoor and Veldpaus of the first frame's recovered
shape, all of places that two cameras see; and how the points, the tracks and the cameras compare with the truth.
"""

import sys
import time
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from marey.arrays import Floats, Mask
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.io.calibration.readers import read_rig
from marey.io.video.video import open_clip
from marey.nonrigid.core.alignment import rigid_fits
from marey.nonrigid.correspondence.uncalibrated_videos import ViewTracks, track_views
from marey.nonrigid.many_cameras.held_size import HeldSizeShapes, factorise_at_held_size
from marey.nonrigid.many_cameras.many_views import ManyViewShapes

PIECES = {
    "elbow": ((560, 250), (640, 290), (590, 400), (500, 520), (440, 480), (500, 380)),
    "sleeve": ((585, 200), (650, 250), (580, 390), (515, 365)),
    "forearm": ((505, 395), (565, 430), (480, 560), (420, 520)),
}
"""Corners of pieces of the first camera's first picture [px]."""
RANKS = range(1, 6)
FEWEST = 6
"""Points that two cameras must see in a frame that is judged, and frames in which a point must be seen."""


class Surface(NamedTuple):
    """Points of the true surface."""

    corners: Floats
    """(P, 3) numbers of the vertices."""
    weights: Floats
    """(P, 3)."""
    vertices: Floats
    """(F, V, 3) m, world."""

    def points(self) -> Floats:
        """Give them (F, P, 3) [m]; NaN where the mesh is in no picture, or where no surface was hit."""
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
            # Straight lines stay straight in a picture, but equal steps do not stay equal: perspective weights.
            closeness = flat_weights / depth[faces[face]]
            if flat_weights.min() >= 0 and 1 / closeness.sum() < nearest:
                nearest = 1 / closeness.sum()
                corners[number], weights[number] = faces[face], closeness / closeness.sum()
    return Surface(corners, weights, vertices)


def judged(found: ViewTracks) -> tuple[Mask, Mask]:
    """Tell which frames (F,) and points (P,) hold enough."""
    seen = np.isfinite(found.tracks[:, :, 0])
    frames = (seen.sum(axis=2) >= FEWEST).sum(axis=0) >= 2
    return frames, np.asarray(seen[:, frames].any(axis=0).sum(axis=0) >= FEWEST)


def error(shape: Floats, truth: Floats, seen: Mask) -> float:
    """Give the root mean square distance [mm] after centring each frame and one similarity for all.

    Args:
        shape: (F, P, 3) in the first camera's axes, any unit.
        truth: (F, P, 3) [m].
        seen: (F, P) what is judged.
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
    """Give shapes (F, P, 3) in the first camera's axes, of the first basis shapes only where asked."""
    shape = np.einsum("fk,kip->fip", shapes.coefficients[:, :count], shapes.basis[:count])
    return np.einsum("fij,fjp->fpi", shapes.rotation, shape)


def rigid(shape: Floats) -> Floats:
    """Move the first frame's shape (F, P, 3) rigidly, as Spoor and Veldpaus, to fit each frame's."""
    rotation, translation = rigid_fits(shape[0], shape, np.ones(shape.shape[:2], bool))
    return np.einsum("fij,pj->fpi", rotation, shape[0]) + translation[:, None]


def told_tracks(rig: Rig, found: ViewTracks, truth: Floats) -> str:
    """Say how far tracks lie from the true surface's points."""
    parts = []
    for number, camera in enumerate(rig.cameras):
        pixels = camera.project(truth.reshape(-1, 3)).reshape(*truth.shape[:2], 2)
        away = np.linalg.norm(found.tracks[number] - np.swapaxes(pixels, 1, 2), axis=1)
        start = away[found.start]
        parts.append(
            f"{rig.names[number]} {int(np.isfinite(found.probability[number]).sum())} points, wrong (3 px off at "
            f"first) {int((start > 3).sum())}, off {np.nanmedian(away):.2f} px (median), "
            f"{np.nanquantile(away, 0.95):.2f} (95 %)"
        )
    return "; ".join(parts)


def told_cameras(rig: Rig, shapes: ManyViewShapes) -> str:
    parts = []
    first = rig.cameras[0].camera_from_world.rotation
    for number in range(1, len(shapes.scale)):
        true = rig.cameras[number].camera_from_world.rotation @ first.T
        angles = [np.degrees(np.linalg.norm(rotations.log(r))) for r in (shapes.camera_from_first[number], true)]
        parts.append(f"{rig.names[number]} {angles[0]:.1f} (true {angles[1]:.1f})")
    return "degrees from the first camera: " + ", ".join(parts)


def piece(name: str, trial: Path, videos: list[list[np.ndarray]], rig: Rig) -> None:
    within = np.zeros(videos[0][0].shape, np.uint8)
    cv2.fillPoly(within, [np.array(PIECES[name])], (1,))
    started = time.perf_counter()
    found = track_views(videos, within=within > 0)
    followed = time.perf_counter()
    frames, points = judged(found)
    tracks = found.tracks[found.tied][:, frames][..., points]
    held = factorise_at_held_size(tracks)
    factorised = time.perf_counter()
    with np.load(trial / "truth" / "truth.npz") as file:
        truth = surface_at(rig, found.tracks[0, 0].T, file["vertices"].astype(float), file["faces"]).points()
    kept = rig.subset([camera for camera, tied in zip(rig.names, found.tied, strict=True) if tied])
    sys.stdout.write(
        f"{name}: {tracks.shape[3]} points in {tracks.shape[1]} frames; following and matching "
        f"{followed - started:.0f} s, shapes {factorised - followed:.0f} s\n  {told_tracks(rig, found, truth)}\n"
        f"  {told_cameras(kept, held.shapes)}; notes: {' '.join((*found.notes, *held.shapes.notes)) or 'none'}\n"
    )
    told_errors(held, tracks, truth[frames][:, points])


def told_errors(held: HeldSizeShapes, tracks: Floats, truth: Floats) -> None:
    cameras = np.isfinite(tracks[:, :, 0]).sum(axis=0)
    first = truth[0][np.isfinite(truth[0]).all(axis=1)]
    size = 1e3 * float(np.max(np.linalg.norm(first[:, None] - first, axis=2)))
    shapes = held.shapes
    rows = {
        "rigid": rigid(in_camera(shapes)),
        **{f"K={count}": in_camera(shapes, count) for count in RANKS if count <= shapes.rank},
        f"chosen, K={shapes.rank}": in_camera(shapes),
    }
    sys.stdout.write(f"  size {size:.0f} mm; error, mm (% of the size), of places that two cameras see:")
    for name, shape in rows.items():
        away = error(shape, truth, cameras >= 2)
        sys.stdout.write(f" {name} {away:.2f} ({100 * away / size:.2f});")
    away = error(in_camera(shapes), truth, cameras >= 1)
    lonely = float(np.mean(cameras[cameras >= 1] == 1))
    sys.stdout.write(f" also of the {100 * lonely:.0f} % that one sees, {away:.2f} ({100 * away / size:.2f})\n")
    sys.stdout.flush()


def main() -> None:
    shared, names = Path(sys.argv[1]), sys.argv[2:]
    trial = shared / "data" / "people" / "arm3"
    clips = [open_clip(trial / f"cam0{number}.mp4") for number in (1, 2, 3)]
    videos = [[cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in clip.images(range(clip.count))] for clip in clips]
    rig = read_rig(trial / "cameras.toml")
    with threadpool_limits(1):
        for name in names or PIECES:
            piece(name, trial, videos, rig)


if __name__ == "__main__":
    main()
