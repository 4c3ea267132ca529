"""Single pictures on disk."""

from pathlib import Path

import cv2

from marey.arrays import Image
from marey.errors import FileProblem
from marey.io.atomic import replacing


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
