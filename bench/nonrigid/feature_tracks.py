"""Points followed in video, with the rank constraint and without.

`paper`: the given points of nonrigid/paper_video, evaluated by score/tracks.py. `made`: a real image bent by a known
map, corners and places along edges against the truth. `speed`: 30 corners and 80 edges over 500 frames of 640x480
pixels.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from bench.common.parts import add_parts, run_parts
from bench.common.program import score
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.arrays import Floats
from marey.images.matching.feature_tracks import follow_points
from marey.images.matching.features import edge_features, good_features
from marey.io.shapes.tracks import write_tracks
from marey.io.video.video import open_clip
from marey.nonrigid.tracking.rank_tracking import refine_tracks, track_features

BENCH = Bench(
    measures="Points followed in video, against marked points and a known map.",
    sources=("src/marey/images/matching", "src/marey/nonrigid/tracking", "src/marey/nonrigid/core"),
    minutes=4,
)
MADE = 120
"""Frames of the made clip."""
SCORES = (
    ("within 2 px, worst later set", "", 3, "within_2px"),
    ("mean", "px", 2, "mean_px"),
)
"""Columns, and the names that score/tracks.py gives; points that are not found count as 100 px."""


def pictures_of(shared: Path) -> list[np.ndarray]:
    clip = open_clip(shared / "data" / "nonrigid" / "paper_video" / "video.mp4")
    return [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in clip.images(range(clip.count))]


def paper(run: Run) -> None:
    """Follow the points of the first set of truth; score both results."""
    pictures = pictures_of(run.shared)
    truth = run.shared / "data" / "nonrigid" / "paper_video" / "truth.npz"
    with np.load(truth) as given:
        points, frame = given["points2d"][0].T, int(given["frames"][0])
    followed = follow_points(pictures, points, frame=frame)
    refined = refine_tracks(pictures, followed)
    columns = [Column(name, unit, digits) for name, unit, digits, _ in SCORES]
    table = run.table(
        "Given points of paper_video", "rank constraint", *columns, Column("seen", "", 3), Column("predicted", "", 3)
    )
    errors = ", ".join(f"{rank:.0f} ({error:.2f})" for rank, error in refined.curve)
    table.note = f"Rank {refined.rank} was chosen; held-out error in px by rank: {errors}."
    for name, tracks in (("off", followed.found), ("on", refined.tracks)):
        path = run.out / "tracks.npz"
        write_tracks(path, tracks)
        scores = score(run, "tracks.py", path, truth)
        table.row(name, *(scores.get(key) for *_, key in SCORES), tracks.visible.mean(), tracks.predicted.mean())


def bent(points: Floats, frame: int) -> Floats:
    """Carry places (P, 2) of the first frame into another: shift, turn and three bends, smooth in time."""
    t = frame / 15
    x, y = ((points - (320, 240)) / 200).T
    turn = 0.1 * np.sin(0.7 * t)
    across = 30 * np.sin(t) - turn * 200 * y + 12 * np.sin(1.6 * t) * (x**2 - y) + 5 * np.sin(2.1 * t) * y**2
    down = 20 * (1 - np.cos(0.8 * t)) + turn * 200 * x + 10 * np.sin(1.3 * t) * x * y
    return points + np.stack([across, down], axis=1)


def bent_picture(picture: np.ndarray, frame: int) -> np.ndarray:
    """Bend an image; its noise of two grey levels is new in each frame."""
    rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]]
    seen = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    source = seen.copy()
    for _ in range(30):
        source += seen - bent(source, frame)
    x, y = source.T.reshape(2, *picture.shape).astype(np.float32)
    moved = cv2.remap(picture.astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    moved += 2 * np.random.default_rng(frame).standard_normal(moved.shape)
    return np.clip(np.round(moved), 0, 255).astype(np.uint8)


def made(run: Run) -> None:
    """Bend one real image; a grey square passes over it."""
    still = pictures_of(run.shared)[10]
    pictures = [bent_picture(still, frame) for frame in range(MADE)]
    for frame in range(40, 70):
        left = 150 + 10 * (frame - 40)
        pictures[frame][150:210, left : left + 60] = 100
    within = np.zeros(still.shape, bool)
    within[100:360, 200:500] = True
    corners = good_features(still, count=30, spacing=20, within=within)
    edges = edge_features(still, count=80, taken=corners, within=within)
    points = np.concatenate([corners, edges])
    followed = follow_points(pictures, points)
    refined = refine_tracks(pictures, followed)
    truth = np.stack([bent(points, frame).T for frame in range(MADE)])
    table = run.table(
        f"{len(corners)} corners and {len(edges)} points along edges of a bent picture, {MADE} frames, rank "
        f"{refined.rank}",
        ("points", "how"), Column("known", "", 3), Column("median", "px", 2), Column("95 % below", "px", 2),
        Column("within 1.96 stated sd", "", 3),
    )  # fmt: skip
    for name, rows in (("corners", slice(None, len(corners))), ("along edges", slice(len(corners), None))):
        fill(table, (name, "followed singly"), followed.found.tracks[1:, :, rows] - truth[1:, :, rows])
        fill(table, (name, "carried by neighbours"), followed.guesses[1:, :, rows] - truth[1:, :, rows])
        fill(table, (name, "under a low rank"), refined.tracks.tracks[1:, :, rows] - truth[1:, :, rows])
        hidden = refined.tracks.predicted[1:, rows]
        error = np.swapaxes(refined.tracks.tracks - truth, 1, 2)[1:, rows]
        sd = np.swapaxes(refined.tracks.tracks_sd, 1, 2)[1:, rows]
        for kind, mask in (("seen", ~hidden), ("predicted", hidden)):
            held = np.mean(np.abs(error) < 1.96 * sd, where=mask[..., None])
            fill(table, (name, f"of these {kind}"), np.swapaxes(error[mask][None], 1, 2), held)


def fill(table: Table, labels: tuple[str, str], error: Floats, held: float | None = None) -> None:
    """Append the errors (F, 2, P) of some points."""
    away = np.linalg.norm(error, axis=1)
    known = np.isfinite(away)
    middle, high = np.percentile(away[known], [50, 95]) if known.any() else (None, None)
    table.row(labels, known.mean(), middle, high, held)


def speed(run: Run) -> None:
    """Play the video there and back, 500 frames in all."""
    pictures = pictures_of(run.shared)
    loop = pictures + pictures[-2:0:-1]
    long = [loop[frame % len(loop)] for frame in range(500)]
    within = np.zeros(long[0].shape, bool)
    within[100:360, 210:500] = True
    track_features(long[:20], within=within)
    began = time.perf_counter()
    refined = track_features(long, within=within)
    seconds = time.perf_counter() - began
    frames, _, points = refined.tracks.tracks.shape
    table = run.table("Duration, without decoding", ("points", "frames", "rank"), Column("time", "s", 1))
    table.row((str(points), str(frames), str(refined.rank)), seconds)


PARTS = {"paper": paper, "made": made, "speed": speed}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
