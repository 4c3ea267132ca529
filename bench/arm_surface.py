"""A moving arm's surface against its true one, and once more as a careless user films it.

    python bench/arm_surface.py SHARED OUT [careless] [as-given]

`careless` is the same clip at half the size, each picture stored as JPEG of quality 50; the cameras are scaled.
Prints what score/surface.py prints.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2

from marey.cli.progress import Progress
from marey.cli.surface import surface
from marey.cli.surface_settings import SurfaceOptions
from marey.io.calibration import write_cameras_toml
from marey.io.trial import read_trial

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


WAYS: dict[str, Callable[[Path, Path], tuple[Path, int]]] = {"careless": careless, "as-given": as_given}


def main() -> None:
    shared, out = Path(sys.argv[1]), Path(sys.argv[2])
    trial = shared / "data" / "people" / "arm3"
    for name in sys.argv[3:] or WAYS:
        folder, spacing = WAYS[name](trial, out)
        started = time.perf_counter()
        surface(folder, SurfaceOptions(out=out / name, spacing=spacing, tracks=False), Progress(quiet=True))
        seconds = time.perf_counter() - started
        score, truth = shared / "score" / "surface.py", trial / "truth" / "truth.npz"
        command = [sys.executable, score, out / name / "surface.npz", truth]
        found = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
        sys.stdout.write(f"{name}, every {spacing} px, {seconds:.0f} s: {found}\n")


if __name__ == "__main__":
    main()
