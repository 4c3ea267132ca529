"""The outline of a silhouette: its pixels, their normals, and which of them is nearest to any pixel."""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask


@dataclass(frozen=True, eq=False)
class Contour:
    """The innermost ring of a silhouette's pixels: those beside a pixel that is outside."""

    mask: Mask
    """(height, width) the silhouette."""
    pixels: Floats
    """(n, 2) x, y of the ring's pixels."""
    inward: Floats
    """(n, 2) unit normals towards the inside."""
    nearest: Integers
    """(h, w) for every pixel of the window the index of the nearest contour pixel."""
    corner: tuple[int, int]
    """x, y of the window's first pixel."""


def trace_contour(mask: Mask, *, reach: int = 60, border: int = 2, blur: float = 1.5) -> Contour:
    """Trace the outline of a silhouette.

    Args:
        mask: (height, width) true inside.
        reach: pixels around the silhouette for which the nearest contour pixel is kept.
        border: contour pixels nearer than this to the picture's border are left out: a person cut by
            the border has no outline there.
        blur: standard deviation [px] of the smoothing from which normals are taken.
    """
    height, width = mask.shape
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if len(rows) == 0:
        return Contour(mask, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 0), np.int64), (0, 0))
    top, bottom = max(rows[0] - reach, 0), min(rows[-1] + reach + 1, height)
    left, right = max(columns[0] - reach, 0), min(columns[-1] + reach + 1, width)
    part = mask[top:bottom, left:right].astype(np.uint8)
    ring = part.astype(bool) & (cv2.erode(part, _CROSS, borderType=cv2.BORDER_REPLICATE) == 0)
    y, x = np.nonzero(ring)
    inner = (x + left >= border) & (x + left < width - border) & (y + top >= border) & (y + top < height - border)
    x, y = x[inner], y[inner]
    normals = _normals(part, x, y, blur)
    # Where a silhouette is a pixel wide both sides cancel, and no direction is left.
    directed = np.linalg.norm(normals, axis=1) > 0.5
    x, y, normals = x[directed], y[directed], normals[directed]
    if len(x) == 0:
        return Contour(mask, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 0), np.int64), (0, 0))
    pixels = np.stack([x + left, y + top], 1).astype(float)
    return Contour(mask, pixels, normals, nearest_pixel(x, y, part.shape), (int(left), int(top)))


_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


def _normals(part: np.ndarray, x: Integers, y: Integers, blur: float) -> Floats:
    smooth = cv2.GaussianBlur(part.astype(np.float32), (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)[y, x]
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)[y, x]
    normals = np.stack([gx, gy], 1).astype(float)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 1e-6, normals / np.maximum(length, 1e-6), 0.0)


def nearest_pixel(x: Integers, y: Integers, shape: tuple[int, ...]) -> Integers:
    """Find for every pixel of a window which of some pixels is nearest.

    Args:
        x: (n,) columns in the window, at least one.
        y: (n,) rows.
        shape: rows and columns of the window.

    Returns:
        (rows, columns) index of the nearest one.
    """
    away = np.ones(shape, np.uint8)
    away[y, x] = 0
    _, labels = cv2.distanceTransformWithLabels(away, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    index = np.zeros(labels.max() + 1, np.int64)
    index[labels[y, x]] = np.arange(len(x))
    return index[labels]
