"""Brightness of whole images over time, in cells, which light that is switched on changes otherwise than motion."""

import cv2
import numpy as np

from marey.arrays import Floats, Image

CELLS = (8, 6)
"""Number of cells across and down an image: a person who moves changes some of them, a light most. Chosen by hand."""


def cell_brightness(image: Image) -> Floats:
    """Return the mean grey level of each cell of an image.

    Args:
        image: (height, width, 3) uint8 in blue, green, red.

    Returns:
        (48,) from 0 to 255.
    """
    small = cv2.resize(image, CELLS, interpolation=cv2.INTER_AREA)
    return np.asarray(small.astype(float).mean(axis=2).ravel())


def brightness_changes(cells: Floats) -> Floats:
    """Return by how much most of an image becomes brighter from one picture to the next.

    Args:
        cells: (F, cells) of successive pictures, from 0 to 255.

    Returns:
        (F,) median over the cells of the change, relative to the usual level of the cell; 0 for the first picture.
    """
    if len(cells) < 2:
        return np.zeros(len(cells))
    usual = np.median(cells, axis=0) + 1.0
    return np.append(0.0, np.median(np.diff(cells, axis=0) / usual, axis=1))
