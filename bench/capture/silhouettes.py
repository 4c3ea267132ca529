"""Silhouettes of a trial: writes masks/<camera>.npz, to be scored beside the truth, and prints the time per picture.

    python bench/silhouettes.py TRIAL OUT [--every N] [--alone] [--plate file|take|dark|marred] [--grey]

Each picture starts from the result of the one before, as long as no tracked body is there to predict it (--alone:
from nothing). --plate take: the background comes from the take itself; dark: the plate is exposed a tenth less and
noisy; marred: it has a black bar and a ghost.
"""

import argparse
import sys
import time
import tomllib
from pathlib import Path

import cv2
import numpy as np

from marey.images import background as backgrounds
from marey.images.silhouettes import Silhouette, segment


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
        return backgrounds.doubted(backgrounds.from_pictures([convert(p) for p in video(file)[::6]]), pictures)
    picture = cv2.imread(str(file))
    if kind == "dark":
        noise = np.random.default_rng(1).normal(0, 3, picture.shape)
        picture = np.clip(0.9 * picture + noise, 0, 255).astype(np.uint8)
    if kind == "marred":
        height, width = picture.shape[:2]
        picture[: height // 50] = 0
        part = (slice(height // 3, height // 2), slice(width // 3, width // 3 + width // 12))
        picture[part] = picture[part] // 3 + np.array([20, 60, 120], np.uint8)
    return backgrounds.doubted(backgrounds.from_pictures([convert(picture)]), pictures)


def silhouettes(trial: Path, camera: str, options: argparse.Namespace) -> tuple[np.ndarray, list[float]]:
    pictures = video(next(trial.glob(f"{camera}.*")))
    convert = backgrounds.grey if options.grey else np.ascontiguousarray
    take = options.plate == "take"
    frames = backgrounds.worth_seeing(len(pictures)) if take else np.linspace(0, len(pictures) - 1, 12).astype(int)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trial", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--grey", action="store_true")
    parser.add_argument("--plate", choices=("file", "take", "dark", "marred"), default="file")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    (options.out / "masks").mkdir(parents=True, exist_ok=True)
    cameras = [name for name in tomllib.loads((options.trial / "cameras.toml").read_text()) if name != "metadata"]
    for camera in cameras:
        masks, times = silhouettes(options.trial, camera, options)
        np.savez_compressed(options.out / "masks" / f"{camera}.npz", shape=masks.shape, bits=np.packbits(masks))
        if times:
            low, median = (1e3 * np.percentile(times, part) for part in (10, 50))
            sys.stdout.write(f"{camera} {masks.shape[2]}x{masks.shape[1]}: {median:.1f} ms a picture ")
            sys.stdout.write(f"(median of the process time; one in ten below {low:.1f})\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
