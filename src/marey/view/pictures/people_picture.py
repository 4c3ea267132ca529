"""People with their numbers in an image."""

from collections.abc import Sequence

import cv2
import numpy as np

from marey.arrays import Floats, Image

_COLOURS = ((60, 180, 255), (255, 160, 60), (90, 220, 90), (220, 110, 230), (90, 230, 230), (120, 120, 255))
"""Colours of the people in turn: blue, green, red."""
_MARGIN_PX = 6
"""Distance of a box from the points in it [px]."""


def draw_people(image: Image, people: Sequence[tuple[int, Floats]]) -> Image:
    """Draw a box with its number about each person.

    Args:
        image: (height, width, C) uint8, blue first.
        people: Number and known pixels (n, 2) of each person in the image.

    Returns:
        (height, width, 3) a copy of the image with the boxes.
    """
    drawn = np.ascontiguousarray(np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image.copy())
    size = max(drawn.shape[:2]) / 640
    for number, pixels in people:
        if not len(pixels):
            continue
        colour = _COLOURS[(number - 1) % len(_COLOURS)]
        left, top = (int(v) for v in np.floor(pixels.min(0)) - _MARGIN_PX * size)
        right, bottom = (int(v) for v in np.ceil(pixels.max(0)) + _MARGIN_PX * size)
        width = max(1, round(2 * size))
        cv2.rectangle(drawn, (left, top), (right, bottom), colour, width, cv2.LINE_AA)
        text = str(number)
        (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.9 * size, width)
        x, y = max(left, 0), max(top - 4, high + 4)
        cv2.rectangle(drawn, (x, y - high - 4), (x + wide + 4, y + 4), (20, 20, 20), -1)
        cv2.putText(drawn, text, (x + 2, y), cv2.FONT_HERSHEY_SIMPLEX, 0.9 * size, colour, width, cv2.LINE_AA)
    return drawn
