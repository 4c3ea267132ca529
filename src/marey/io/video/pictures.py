"""Writing of single images, and of the grey images of a video to a temporary file."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Image
from marey.errors import FileProblem, NotWritten
from marey.io.atomic import naming_unwritten, replacing, reserve
from marey.io.video.video import Clip


def write_picture(path: Path | str, image: Image) -> None:
    """Write an image in the format given by the file name extension.

    Args:
        path: The file.
        image: (H, W, 3) blue, green and red, or (H, W) grey; uint8.

    Raises:
        FileProblem: The image cannot be written.
    """
    try:
        done, content = cv2.imencode(Path(path).suffix, image)
    except cv2.error:  # the extension is unknown
        done, content = False, np.zeros(0, np.uint8)
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
        FileProblem: An image is damaged.
        NotWritten: There is not enough space on the disk.
    """
    width, height = clip.size
    try:
        with naming_unwritten(path):
            grey = np.lib.format.open_memmap(path, "w+", np.uint8, (len(frames), height, width))
            # A write to a mapped file on a full disk would end the process.
            reserve(path, path.stat().st_size)
    except NotWritten:
        path.unlink(missing_ok=True)
        raise
    for number, image in enumerate(clip.images(frames)):
        grey[number] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        step()
    return list(grey)
