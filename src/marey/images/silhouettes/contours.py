"""Contours of silhouettes: their pixels, normals, and the search of the nearest pixel."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.images.silhouettes.nearest import Cells, sort_into_cells

CONTOUR_BORDER = 2
"""Contour pixels nearer than this to the image border are excluded, because a person cut by the border has no outline
there [px]. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class SilhouetteContour:
    """The outermost pixels of a silhouette: those with a neighbour outside it."""

    mask: Mask
    """(height, width) the silhouette."""
    pixels: Floats
    """(n, 2) x, y of the contour's pixels."""
    inward: Floats
    """(n, 2) unit normals towards the inside."""

    @cached_property
    def cells(self) -> Cells:
        """The contour's pixels, sorted into cells for a fast search of the nearest one."""
        cells: Cells = sort_into_cells(self.pixels)
        return cells


def trace_contour(
    mask: Mask, *, hidden: Mask | None = None, border: int = CONTOUR_BORDER, blur: float = 1.5
) -> SilhouetteContour:
    """Trace the outline of a silhouette.

    Args:
        mask: (height, width) true inside.
        hidden: (height, width) true where something hides the person: beside it, the silhouette's border is the
            other thing's and no outline.
        border: Contour pixels nearer than this to the image border are excluded, see `CONTOUR_BORDER` [px].
        blur: Standard deviation of the smoothing from whose gradient the normals are taken [px].

    Returns:
        The contour; without pixels if the mask is empty.
    """
    height, width = mask.shape
    picture = np.ascontiguousarray(mask).view(np.uint8)
    first_x, first_y, columns, rows = cv2.boundingRect(picture)
    if rows == 0:
        return SilhouetteContour(mask, np.zeros((0, 2)), np.zeros((0, 2)))
    margin = int(np.ceil(4 * blur)) + 1
    top, bottom = max(first_y - margin, 0), min(first_y + rows + margin, height)
    left, right = max(first_x - margin, 0), min(first_x + columns + margin, width)
    part = picture[top:bottom, left:right]
    ring = cv2.subtract(part, cv2.erode(part, _CROSS, borderType=cv2.BORDER_REPLICATE))
    found = cv2.findNonZero(ring)
    x, y = np.zeros((2, 0), np.int64) if found is None else found.reshape(-1, 2).T.astype(np.int64)
    inner = (x + left >= border) & (x + left < width - border) & (y + top >= border) & (y + top < height - border)
    if hidden is not None:
        beside = cv2.dilate(np.ascontiguousarray(hidden).view(np.uint8), np.ones((5, 5), np.uint8)) > 0
        inner &= ~beside[y + top, x + left]
    x, y = x[inner], y[inner]
    normals = _normals(part, x, y, blur)
    # Where a silhouette is one pixel wide, the gradients of both sides cancel and the normal is undefined.
    directed = np.linalg.norm(normals, axis=1) > 0.5
    x, y, normals = x[directed], y[directed], normals[directed]
    if len(x) == 0:
        return SilhouetteContour(mask, np.zeros((0, 2)), np.zeros((0, 2)))
    pixels = np.stack([x + left, y + top], 1).astype(float)
    return SilhouetteContour(mask, pixels, normals)


_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
"""Structuring element of a pixel and its four neighbours."""


def _normals(part: np.ndarray, x: Integers, y: Integers, blur: float) -> Floats:
    smooth = cv2.GaussianBlur(part.astype(np.float32), (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)[y, x]
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)[y, x]
    normals = np.stack([gx, gy], 1).astype(float)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # The weakest true edge is far above this threshold, rounding errors of two cancelling sides are far below it.
    return np.where(length > 1e-3, normals / np.maximum(length, 1e-3), 0.0)
