"""Writing of single pictures, and of the grey pictures of a video to a temporary file."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Image
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.video.video import Clip


def write_picture(path: Path | str, image: Image) -> None:
    """Write a picture in the format given by the file name extension.

    Args:
        path: The file.
        image: (H, W, 3) blue, green and red, or (H, W) grey; uint8.

    Raises:
        FileProblem: The picture cannot be written.
    """
    done, content = cv2.imencode(Path(path).suffix, image)
    if not done:
        raise FileProblem(path, "cannot be written as a picture", "Use the extension .png or .jpg.")
    with replacing(path) as beside:
        beside.write_bytes(content.tobytes())


def grey_pictures(path: Path, clip: Clip, frames: Sequence[int], step: Callable[[], None]) -> list[np.ndarray]:
    """Decode pictures to grey ones in a memory-mapped file, which can be accessed in any order.

    Args:
        path: The temporary file (NPY); it may be deleted after use.
        clip: The video.
        frames: Numbers of its pictures, in ascending order.
        step: Called after each picture.

    Returns:
        F pictures (H, W) uint8, mapped to the file.

    Raises:
        FileProblem: A picture is damaged, or the file cannot be written.
    """
    width, height = clip.size
    try:
        grey = np.lib.format.open_memmap(path, "w+", np.uint8, (len(frames), height, width))
    except OSError as problem:
        raise FileProblem(
            path,
            f"cannot be written ({problem.strerror})",
            "Free some space there, or choose another folder with --out.",
        ) from problem
    for number, image in enumerate(clip.images(frames)):
        grey[number] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        step()
    return list(grey)
