"""Silhouettes of a take, image by image: overlap with the truth and time per image.

Each image starts from the result of the one before, since no tracked body predicts it here (`--alone`: from
nothing). `--plate take` estimates the background from the take itself; `dark` exposes the plate 10 % less and adds
noise; `marred` adds a black bar and a ghost.
"""

import argparse
import time
import tomllib
from pathlib import Path

import cv2
import numpy as np

from bench.common.program import empty_frames, score
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.images.silhouettes import background as backgrounds
from marey.images.silhouettes.silhouettes import Silhouette, segment

BENCH = Bench(
    measures="Overlap of silhouettes with the true masks, and processor time per picture.",
    sources=("src/marey/images",),
    minutes=4,
)
TAKES = ("walk", "reach", "stealth", "jacks")


def video(path: Path) -> np.ndarray:
    capture, pictures = cv2.VideoCapture(str(path)), []
    while True:
        going, picture = capture.read()
        if not going:
            return np.stack(pictures)
        pictures.append(picture)


def plate(trial: Path, camera: str, pictures: list[np.ndarray], kind: str, convert) -> backgrounds.Background:
    if kind == "take":
        return backgrounds.from_take(pictures)
    file = next((trial / "background").glob(f"{camera}.*"))
    if file.suffix in (".avi", ".mp4"):
        return backgrounds.with_reduced_weight(
            backgrounds.from_pictures([convert(p) for p in video(file)[::6]]), pictures
        )
    picture = cv2.imread(str(file))
    if kind == "dark":
        noise = np.random.default_rng(1).normal(0, 3, picture.shape)
        picture = np.clip(0.9 * picture + noise, 0, 255).astype(np.uint8)
    if kind == "marred":
        height, width = picture.shape[:2]
        picture[: height // 50] = 0
        part = (slice(height // 3, height // 2), slice(width // 3, width // 3 + width // 12))
        picture[part] = picture[part] // 3 + np.array([20, 60, 120], np.uint8)
    return backgrounds.with_reduced_weight(backgrounds.from_pictures([convert(picture)]), pictures)


def silhouettes(trial: Path, camera: str, options: argparse.Namespace) -> tuple[np.ndarray, list[float]]:
    pictures = video(next(trial.glob(f"{camera}.*")))
    convert = backgrounds.grey if options.grey else np.ascontiguousarray
    take = options.plate == "take"
    frames = backgrounds.background_frames(len(pictures)) if take else np.linspace(0, len(pictures) - 1, 12).astype(int)
    behind = plate(trial, camera, [convert(pictures[k]) for k in frames], options.plate, convert)
    masks, times = np.zeros(pictures.shape[:3], bool), []
    last: Silhouette | None = None
    for k in range(0, len(pictures), options.every):
        begin = time.process_time()
        follow = last is not None and last.mask.any() and not options.alone
        last = (
            segment(convert(pictures[k]), behind, start=last.mask, before=last)
            if follow
            else segment(convert(pictures[k]), behind)
        )
        if follow:
            times.append(time.process_time() - begin)
        masks[k] = last.mask
    return masks, times


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help=f"of data/people; {', '.join(TAKES)} without any")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only each N-th picture")
    parser.add_argument("--alone", action="store_true", help="start each picture from nothing")
    parser.add_argument("--grey", action="store_true", help="use grey pictures")
    parser.add_argument("--plate", choices=("file", "take", "dark", "marred"), default="file")


def run(run: Run) -> None:
    """Segment and score."""
    columns = (
        Column("silhouettes IoU", "", 3),
        Column("per picture, median", "ms", 1),
        Column("fastest 10 %", "ms", 1),
    )
    table = run.table("Silhouettes without a tracked body", "take", *columns)
    cv2.setNumThreads(1)
    for name in run.arguments.takes or TAKES:
        trial, out = run.shared / "data" / "people" / name, run.out / "silhouettes" / name
        (out / "masks").mkdir(parents=True, exist_ok=True)
        spent: list[float] = []
        for camera in tomllib.loads((trial / "cameras.toml").read_text()):
            if camera != "metadata":
                masks, times = silhouettes(trial, camera, run.arguments)
                np.savez_compressed(out / "masks" / f"{camera}.npz", shape=masks.shape, bits=np.packbits(masks))
                spent += times
        low, median = 1e3 * np.percentile(spent, (10, 50)) if spent else (None, None)
        truth = trial / "truth" / "masks.npz"
        skip = ("--skip-empty", empty_frames(trial))
        table.row(name, score(run, "masks.py", out, truth, *skip)["iou"] if truth.exists() else None, median, low)
