"""A sheet of small images with their names, to recognise cameras."""

from collections.abc import Mapping

import cv2
import numpy as np

from marey.arrays import Image

_CELL = (480, 320)
"""Width and height of an image on the sheet, name included [px]. Chosen by hand."""
_CAPTION = 36
"""Height of the name above an image [px]."""
_BACKGROUND = 32
"""Grey level around the images."""
_TEXT = (240, 240, 240)
"""Colour of the names."""


def contact_sheet(images: Mapping[str, Image]) -> Image:
    """Draw images side by side with their names.

    Args:
        images: (H, W, 3) uint8 by name, in the order of the sheet; at least one.

    Returns:
        (height, width, 3) uint8.
    """
    columns = int(np.ceil(np.sqrt(len(images))))
    rows = -(-len(images) // columns)
    width, height = _CELL
    sheet = np.full((rows * height, columns * width, 3), _BACKGROUND, np.uint8)
    for number, (name, image) in enumerate(images.items()):
        top, left = number // columns * height, number % columns * width
        scale = min((width - 8) / image.shape[1], (height - _CAPTION - 8) / image.shape[0])
        size = (max(1, int(image.shape[1] * scale)), max(1, int(image.shape[0] * scale)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        x = left + (width - size[0]) // 2
        sheet[top + _CAPTION : top + _CAPTION + size[1], x : x + size[0]] = small
        # OpenCV draws only ASCII.
        plain = name.encode("ascii", "replace").decode()
        cv2.putText(sheet, plain, (left + 8, top + 25), cv2.FONT_HERSHEY_SIMPLEX, 0.7, _TEXT, 1, cv2.LINE_AA)
    return sheet
