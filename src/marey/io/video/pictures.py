"""Writing of single images, and of the grey images of a video to a temporary file."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Image
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.video.video import Clip


def write_picture(path: Path | str, image: Image) -> None:
    """Write an image in the format given by the file name extension.

    Args:
        path: The file.
        image: (H, W, 3) blue, green and red, or (H, W) grey; uint8.

    Raises:
        FileProblem: The image cannot be written.
    """
    done, content = cv2.imencode(Path(path).suffix, image)
    if not done:
        raise FileProblem(path, "cannot be written as an image", "Use the extension .png or .jpg.")
    with replacing(path) as beside:
        beside.write_bytes(content.tobytes())


def grey_pictures(path: Path, clip: Clip, frames: Sequence[int], step: Callable[[], None]) -> list[np.ndarray]:
    """Decode images to grey ones in a memory-mapped file, which can be accessed in any order.

    Args:
        path: The temporary file (NPY); it may be deleted after use.
        clip: The video.
        frames: Numbers of its images, in ascending order.
        step: Called after each image.

    Returns:
        F images (H, W) uint8, mapped to the file.

    Raises:
        FileProblem: An image is damaged, or the file cannot be written.
    """
    width, height = clip.size
    try:
        grey = np.lib.format.open_memmap(path, "w+", np.uint8, (len(frames), height, width))
    except OSError as problem:
        raise FileProblem(
            path,
            f"cannot be written ({problem.strerror})",
            "Free some space there, or choose another folder for the results (--out).",
        ) from problem
    for number, image in enumerate(clip.images(frames)):
        grey[number] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        step()
    return list(grey)
