"""A few frames of the example take with silhouettes and joints that are known: a capture of seconds."""

import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.trial.masks import write_masks
from marey.io.video.pictures import write_picture
from marey.io.video.video_writer import VideoWriter

EXAMPLE = Path(__file__).parents[3] / "examples" / "reach"
EMPTY = 10
"""Leading frames without a person, which the truth leaves out."""
HALF = (320, 240)
"""Width and height of the images of the example at half size [px]."""


def copy_trial(folder: Path) -> Path:
    """Copy the example without its truth."""
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("truth", "README.md", "marey"))
    return folder


def copy_half_trial(folder: Path) -> Path:
    """Copy the example without its truth, with images of half the width and height: a quarter of the work on them."""
    shutil.copytree(_half_example(), folder)
    return folder


@cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    """Return a folder that lasts as long as the process."""
    return tempfile.TemporaryDirectory(prefix="reach-")


@cache
def _half_example() -> Path:
    folder = Path(_scratch().name) / "half"
    (folder / "background").mkdir(parents=True)
    rig = read_rig(EXAMPLE / "cameras.toml")
    write_cameras_toml(rig.scaled(0.5), folder / "cameras.toml")
    for camera in rig:
        picture = cv2.imread(str(EXAMPLE / "background" / f"{camera.name}.png"))
        write_picture(folder / "background" / f"{camera.name}.png", _half(picture))
        film = cv2.VideoCapture(str(EXAMPLE / f"{camera.name}.mp4"))
        with VideoWriter(folder / f"{camera.name}.mp4", HALF, rate=film.get(cv2.CAP_PROP_FPS)) as writer:
            while (read := film.read())[0]:
                writer.add(_half(read[1]))
        film.release()
    return folder


def _half(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, HALF, interpolation=cv2.INTER_AREA)


def truth() -> tuple[list[str], np.ndarray]:
    """Names and true places (F, J, 3) of the joints [m]."""
    with np.load(EXAMPLE / "truth" / "truth.npz") as stored:
        sides = {"l": "left", "r": "right"}
        parts = [str(name).split("_") for name in stored["joint_names"]]
        return ["_".join([sides.get(first, first), *rest]) for first, *rest in parts], stored["joints"]


@cache
def true_masks(size: tuple[int, int]) -> np.ndarray:
    """True silhouettes (C, F, H, W) in images of this width and height."""
    with np.load(EXAMPLE / "truth" / "masks.npz") as stored:
        masks = np.unpackbits(stored["bits"])[: stored["shape"].prod()].reshape(stored["shape"]).astype(bool)
    if masks.shape[:1:-1] == size:
        return masks
    # A pixel of half size is of the person if two of its four are.
    count = np.zeros((*masks.shape[:2], size[1], size[0]), np.uint8)
    for row in range(2):
        for column in range(2):
            count += masks[..., row::2, column::2]
    return count >= 2


def give_silhouettes(trial: Path) -> None:
    """Write the true silhouettes to the trial."""
    shutil.copytree(_written_silhouettes(read_rig(trial / "cameras.toml").cameras[0].size), trial / "masks")


@cache
def _written_silhouettes(size: tuple[int, int]) -> Path:
    folder, masks = Path(_scratch().name) / f"masks{size[0]}", true_masks(size)
    folder.mkdir()
    for c, own in enumerate(masks):
        empty: list = [None] * EMPTY
        write_masks(folder / f"cam{c + 1:02}.npz", [*empty, *own], shape=(EMPTY + len(own), *own.shape[1:]))
    return folder


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
