"""A few frames of the example take with silhouettes and joints that are known: a capture of seconds."""

import json
import shutil
from pathlib import Path

import numpy as np

from marey.io.calibration.readers import read_rig
from marey.io.trial.masks import write_masks

EXAMPLE = Path(__file__).parents[3] / "examples" / "reach"
EMPTY = 10
"""Leading frames without a person, which the truth leaves out."""


def copy_trial(folder: Path) -> Path:
    """Copy the example without its truth."""
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("truth", "README.md", "marey"))
    return folder


def truth() -> tuple[list[str], np.ndarray]:
    """Names and true places (F, J, 3) of the joints [m]."""
    with np.load(EXAMPLE / "truth" / "truth.npz") as stored:
        sides = {"l": "left", "r": "right"}
        parts = [str(name).split("_") for name in stored["joint_names"]]
        return ["_".join([sides.get(first, first), *rest]) for first, *rest in parts], stored["joints"]


def give_silhouettes(trial: Path) -> None:
    """Write the true silhouettes to the trial."""
    with np.load(EXAMPLE / "truth" / "masks.npz") as stored:
        cameras, frames, height, width = map(int, stored["shape"])
        masks = np.unpackbits(stored["bits"])[: stored["shape"].prod()].reshape(stored["shape"]).astype(bool)
    (trial / "masks").mkdir()
    for c in range(cameras):
        empty: list = [None] * EMPTY
        shape = (EMPTY + frames, height, width)
        write_masks(trial / "masks" / f"cam{c + 1:02}.npz", [*empty, *masks[c]], shape=shape)


def give_start(trial: Path, frame: int) -> Path:
    """Write the joints of a frame as clicks, and return the file."""
    names, joints = truth()
    clicks: dict = {"frame": frame}
    limbs = [i for i, name in enumerate(names) if name.startswith(("left", "right"))]
    for camera in read_rig(trial / "cameras.toml"):
        pixels = camera.project(joints[frame - EMPTY])
        clicks[camera.name] = {names[i]: pixels[i].round(1).tolist() for i in limbs}
    path = trial / "clicks.json"
    path.write_text(json.dumps(clicks))
    return path
