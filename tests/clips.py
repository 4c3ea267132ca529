"""Small trials for tests: images that carry their own frame number."""

import struct
from pathlib import Path

import cv2
import numpy as np

BITS = 8
SIZE = (64, 48)

CAMERA = """
[{name}]
name = "{name}"
size = [ {width}.0, {height}.0]
matrix = [ [ 60.0, 0.0, 32.0], [ 0.0, 60.0, 24.0], [ 0.0, 0.0, 1.0]]
distortions = [ 0.0, 0.0, 0.0, 0.0]
rotation = [ 1.2, {turn}, -1.2]
translation = [ 0.1, 0.2, 3.0]
"""


def numbered_picture(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Draw a number as black and white columns."""
    image = np.zeros((size[1], size[0], 3), np.uint8)
    for bit in range(BITS):
        left, right = size[0] * bit // BITS, size[0] * (bit + 1) // BITS
        image[:, left:right] = 220 if number >> bit & 1 else 20
    return image


def number_of(image: np.ndarray) -> int:
    """Read the number that `numbered_picture` drew."""
    columns = [int(image[:, image.shape[1] * (2 * bit + 1) // (2 * BITS)].mean() > 120) for bit in range(BITS)]
    return sum(value << bit for bit, value in enumerate(columns))


def write_video(path: Path, count: int, *, size: tuple[int, int] = SIZE, rate: float = 25.0) -> Path:
    """Write a video of numbered images."""
    code = cv2.VideoWriter_fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v"))
    writer = cv2.VideoWriter(str(path), code, rate, size)
    for number in range(count):
        writer.write(numbered_picture(number, size))
    writer.release()
    return path


def calibration_text(names: tuple[str, ...], size: tuple[int, int] = SIZE) -> str:
    """Write cameras.toml for cameras that look from all sides."""
    tables = (
        CAMERA.format(name=name, width=size[0], height=size[1], turn=0.3 * number) for number, name in enumerate(names)
    )
    return "".join(tables)


def make_trial(parent: Path, names: tuple[str, ...] = ("cam01", "cam02"), *, count: int = 12, toml: str = "") -> Path:
    """Write a trial with one video per camera."""
    folder = parent / "trial"
    folder.mkdir()
    (folder / "cameras.toml").write_text(calibration_text(names))
    for name in names:
        write_video(folder / f"{name}.mp4", count)
    if toml:
        (folder / "trial.toml").write_text(toml)
    return folder


def turn_by_metadata(path: Path, quarters: int) -> None:
    """State in the header of an MP4 that its images are to be shown turned clockwise by quarter turns."""
    content = bytearray(path.read_bytes())
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    # The matrix in the track's header, as a phone held upright writes it.
    at = content.find(b"tkhd") + 4 + 40
    one = 1 << 16
    numbers = (cosine * one, sine * one, 0, -sine * one, cosine * one, 0, 0, 0, 1 << 30)
    content[at : at + 36] = struct.pack(">9i", *numbers)
    path.write_bytes(content)
