"""How well points are followed in video, with the rank constraint and without: `python bench/feature_tracks.py SHARED`.

Parts: paper (the given points of nonrigid/paper_video, judged by score/tracks.py), made (a real picture bent by a known
map: corners and places along edges against the truth), speed (30 corners and 80 edges over 500 frames of 640x480).
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from parts import run_parts

from marey.arrays import Floats
from marey.images.matching.feature_tracks import FeatureTracks, follow_points
from marey.images.matching.features import edge_features, good_features
from marey.io.shapes.tracks import write_tracks
from marey.io.video.video import open_clip
from marey.nonrigid.tracking.rank_tracking import refine_tracks, track_features

MADE = 120


def main() -> None:
    run_parts(__doc__, {"paper": paper, "made": made, "speed": speed})


def pictures_of(shared: Path) -> list[np.ndarray]:
    clip = open_clip(shared / "data" / "nonrigid" / "paper_video" / "video.mp4")
    return [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in clip.images(range(clip.count))]


def paper(shared: Path) -> None:
    """Follow the points of the first set of truth; score both results."""
    pictures = pictures_of(shared)
    truth = shared / "data" / "nonrigid" / "paper_video" / "truth.npz"
    with np.load(truth) as given:
        points, frame = given["points2d"][0].T, int(given["frames"][0])
    followed = follow_points(pictures, points, frame=frame)
    refined = refine_tracks(pictures, followed)
    print(f"rank {refined.rank}; held-out error, px: " + ", ".join(f"{r:.0f} {e:.2f}" for r, e in refined.curve))
    for name, tracks in (("rank constraint off", followed.found), ("rank constraint on", refined.tracks)):
        print(f"{name}: seen {tracks.visible.mean():.3f}, predicted {tracks.predicted.mean():.3f}")
        score(shared, tracks, truth)


def score(shared: Path, tracks: FeatureTracks, truth: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tracks.npz"
        write_tracks(path, tracks)
        command = [sys.executable, str(shared / "score" / "tracks.py"), str(path), str(truth)]
        print(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def bent(points: Floats, frame: int) -> Floats:
    """Carry places (P, 2) of the first frame into another: shift, turn and three bends, smooth in time."""
    t = frame / 15
    x, y = ((points - (320, 240)) / 200).T
    turn = 0.1 * np.sin(0.7 * t)
    across = 30 * np.sin(t) - turn * 200 * y + 12 * np.sin(1.6 * t) * (x**2 - y) + 5 * np.sin(2.1 * t) * y**2
    down = 20 * (1 - np.cos(0.8 * t)) + turn * 200 * x + 10 * np.sin(1.3 * t) * x * y
    return points + np.stack([across, down], axis=1)


def bent_picture(picture: np.ndarray, frame: int) -> np.ndarray:
    """Bend a picture; its noise of two grey levels is new in each frame."""
    rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]]
    seen = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    source = seen.copy()
    for _ in range(30):
        source += seen - bent(source, frame)
    x, y = source.T.reshape(2, *picture.shape).astype(np.float32)
    moved = cv2.remap(picture.astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    moved += 2 * np.random.default_rng(frame).standard_normal(moved.shape)
    return np.clip(np.round(moved), 0, 255).astype(np.uint8)


def made(shared: Path) -> None:
    """Bend one real picture; a grey square passes over it."""
    still = pictures_of(shared)[10]
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
    print(f"{len(corners)} corners, {len(edges)} along edges, rank {refined.rank}")
    for name, rows in (("corners", slice(None, len(corners))), ("along edges", slice(len(corners), None))):
        report(f"{name}, followed singly", followed.found.tracks[1:, :, rows] - truth[1:, :, rows])
        report(f"{name}, carried by neighbours", followed.guesses[1:, :, rows] - truth[1:, :, rows])
        report(f"{name}, refined", refined.tracks.tracks[1:, :, rows] - truth[1:, :, rows])
        hidden = refined.tracks.predicted[1:, rows]
        error = np.swapaxes(refined.tracks.tracks - truth, 1, 2)[1:, rows]
        sd = np.swapaxes(refined.tracks.tracks_sd, 1, 2)[1:, rows]
        report(f"{name}, of these predicted", np.swapaxes(error[hidden][None], 1, 2))
        for kind, mask in (("seen", ~hidden), ("predicted", hidden)):
            held = np.mean(np.abs(error) < 1.96 * sd, where=mask[..., None])
            print(f"    within 1.96 stated deviations, {kind}: {held:.3f}")


def report(name: str, error: Floats) -> None:
    away = np.linalg.norm(error, axis=1)
    known = np.isfinite(away)
    if not known.any():
        print(f"  {name}: none")
        return
    middle, high = np.percentile(away[known], [50, 95])
    print(f"  {name}: known {known.mean():.3f}, median {middle:.2f}, 95 % below {high:.2f} px")


def speed(shared: Path) -> None:
    """Play the video there and back, 500 frames in all."""
    pictures = pictures_of(shared)
    loop = pictures + pictures[-2:0:-1]
    long = [loop[frame % len(loop)] for frame in range(500)]
    within = np.zeros(long[0].shape, bool)
    within[100:360, 210:500] = True
    track_features(long[:20], within=within)
    began = time.perf_counter()
    refined = track_features(long, within=within)
    seconds = time.perf_counter() - began
    frames, _, points = refined.tracks.tracks.shape
    print(f"{points} points, {frames} frames, rank {refined.rank}: {seconds:.1f} s without decoding")


if __name__ == "__main__":
    main()
