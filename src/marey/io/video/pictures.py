"""Pictures on disk: single ones, and the grey ones of a video while work on it lasts."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Image
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.video.video import Clip


def write_picture(path: Path | str, image: Image) -> None:
    """Write a picture; the ending says in which format.

    Args:
        path: The file.
        image: (H, W, 3) blue, green, red, or (H, W).

    Raises:
        FileProblem: It cannot be written.
    """
    done, content = cv2.imencode(Path(path).suffix, image)
    if not done:
        raise FileProblem(path, "cannot be written as a picture", "Give it the ending .png or .jpg.")
    with replacing(path) as beside:
        beside.write_bytes(content.tobytes())


def grey_pictures(path: Path, clip: Clip, frames: Sequence[int], step: Callable[[], None]) -> list[np.ndarray]:
    """Decode pictures into a file of grey ones, which can be read in any order without holding them in memory.

    Args:
        path: The file, NPY; it belongs to the work and may be deleted after it.
        clip: The video.
        frames: Which of its pictures, in rising order.
        step: Is called after each.

    Returns:
        F pictures (H, W) uint8, which lie in the file.

    Raises:
        FileProblem: A picture is damaged, or the file cannot be written.
    """
    width, height = clip.size
    try:
        grey = np.lib.format.open_memmap(path, "w+", np.uint8, (len(frames), height, width))
    except OSError as problem:
        raise FileProblem(
            path, f"cannot be written ({problem.strerror})", "Make room there, or give --out."
        ) from problem
    for number, image in enumerate(clip.images(frames)):
        grey[number] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        step()
    return list(grey)
