"""A moving arm's surface against its true one, and once more as a careless user films it.

    python bench/arm_surface.py SHARED OUT [as-given] [careless] [default]

`as-given` measures every third pixel. `careless` is the same clip at half the size, each picture stored as JPEG of
quality 50; the cameras are scaled. `default` is `marey surface` as it is: every second pixel, and followed. Prints what
score/surface.py prints, how long each stage took, and how honest the stated standard deviations are.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from marey.io.calibration.readers import write_cameras_toml
from marey.io.shapes.measured_surface import read_surface
from marey.io.trial.trial import read_trial
from marey.pipelines.surface.tasks import measure_surface
from marey.process import tuned_process

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
TOLD = (10, 35, 60)
"""Frames in which errors are compared with their standard deviations."""


def honesty(shared: Path, result: Path, truth: Path) -> None:
    """Compare distances along the true surface's normal with the standard deviations stated for that direction."""
    sys.path.insert(0, str(shared / "score"))
    from surface import nearest_on_faces

    points = read_surface(result)
    with np.load(truth) as file:
        vertices, faces = file["vertices"].astype(float), file["faces"]
    for frame in TOLD:
        own = points.of_frame(frame)
        which, weights, _ = nearest_on_faces(own.points, vertices[frame], faces)
        corner = vertices[frame][faces[which]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        off = np.einsum("nc,nc->n", own.points - np.einsum("nk,nkc->nc", weights, corner), normal)
        ratio = np.abs(off) / np.sqrt(np.einsum("ni,nij,nj->n", normal, own.covariance, normal))
        sys.stdout.write(
            f"  frame {frame}: along the normal {np.median(ratio) / 0.6745:.2f} times the stated sd (medians), "
            f"{100 * np.mean(ratio < 1):.0f} % within one, {100 * np.mean(ratio < 1.96):.0f} % within 1.96\n"
        )


def scored(shared: Path, *arguments: str | Path) -> str:
    command = [sys.executable, shared / "score" / "surface.py", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@tuned_process()
def main() -> None:
    shared, out = Path(sys.argv[1]), Path(sys.argv[2])
    trial = shared / "data" / "people" / "arm3"
    truth = trial / "truth" / "truth.npz"
    for name in sys.argv[3:] or WAYS:
        (folder, spacing), tracks = WAYS[name](trial, out), name == "default"
        started = time.perf_counter()
        measure_surface(folder, out=out / name, spacing=spacing, tracks=tracks)
        seconds = time.perf_counter() - started
        found = scored(shared, out / name / "surface.npz", truth)
        took = json.loads((out / name / "run.json").read_text())["timings_s"]
        sys.stdout.write(f"{name}, every {spacing} px, {seconds:.0f} s ({took}): {found}\n")
        honesty(shared, out / name / "surface.npz", truth)
        if tracks:
            sys.stdout.write(f"  {scored(shared, '--tracks', out / name / 'trajectories.npz', truth)}\n")


if __name__ == "__main__":
    main()
