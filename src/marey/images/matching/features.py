"""Feature points for tracking: corners distributed over an image, and points along edges between them."""

import cv2
import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import SettingProblem

_WEAK = 0.01
"""Least strength of corners and edges, as a share of the image's strongest. Chosen by hand."""
_NARROW = 0.2
"""Largest ratio of the square gradients in an edge's weaker and stronger directions. Chosen by hand."""


def good_features(
    image: np.ndarray, *, count: int, spacing: float = 8.0, size: int = 13, within: Mask | None = None
) -> Floats:
    """Detect corners: patches whose square gradient is large in its weakest direction ([Shi1994]).

    Args:
        image: (H, W) grey image.
        count: Largest number of points.
        spacing: Least distance between two points [px].
        size: Width and height of the patches that will be tracked [px], odd.
        within: (H, W) true where points may lie; everywhere if None.

    Returns:
        (n, 2) positions, the strongest first [px]; fewer than `count` if the image has no more.

    Raises:
        SettingProblem: The image is not grey, or a number is impossible.
    """
    weakest, _ = _square_gradients(image, size)
    strength = _allowed(weakest, size, within)
    return _spread_out(strength, count, spacing, np.empty((0, 2)))


def edge_features(
    image: np.ndarray,
    *,
    count: int,
    taken: Floats,
    spacing: float = 8.0,
    size: int = 13,
    within: Mask | None = None,
) -> Floats:
    """Detect points along edges, of which only the motion across the edge is observable ([Irani1999]).

    Args:
        image: (H, W) grey image.
        count: Largest number of points.
        taken: (n, 2) points that are tracked already [px].
        spacing: Least distance from these, and between two of the new points [px].
        size: Width and height of the patches that will be tracked [px], odd.
        within: (H, W) true where points may lie; everywhere if None.

    Returns:
        (n, 2) positions, the strongest first [px]; fewer than `count` if the image has no more.

    Raises:
        SettingProblem: The image is not grey, or a number is impossible.
    """
    weakest, strongest = _square_gradients(image, size)
    along_edge = np.where(weakest <= _NARROW * strongest, strongest, 0)
    return _spread_out(_allowed(along_edge, size, within), count, spacing, taken)


def _square_gradients(image: np.ndarray, size: int) -> tuple[Floats, Floats]:
    """Return the mean square gradient of each patch in its weakest and strongest direction (H, W) [grey2/px2]."""
    if image.ndim != 2:
        raise SettingProblem(f"A grey image has the shape (height, width), not {image.shape}.")
    if size < 3 or size % 2 == 0:
        raise SettingProblem(f"The patch size is {size}; it must be an odd number of pixels from 3 up.")
    grey = np.asarray(image, np.float32)
    across, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(grey, cv2.CV_32F, 0, 1) / 8
    xx, yy, xy = (cv2.blur(product, (size, size)) for product in (across**2, down**2, across * down))
    middle, apart = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return middle - apart, middle + apart


def _allowed(strength: Floats, size: int, within: Mask | None) -> Floats:
    """Set the strength to zero too near to the border for a patch, and outside the allowed region."""
    margin = size // 2 + 3
    kept = np.zeros_like(strength)
    inner = (slice(margin, -margin), slice(margin, -margin))
    kept[inner] = strength[inner]
    return kept if within is None else np.where(within, kept, 0)


def _spread_out(strength: Floats, count: int, spacing: float, taken: Floats) -> Floats:
    """Select the strongest position, then the strongest of those far enough from all selected ones, and so on."""
    if count < 0 or not spacing > 0:
        raise SettingProblem(
            f"Points cannot be chosen with count = {count} and spacing = {spacing:g} px: count must not be negative, "
            "and spacing must be positive."
        )
    peak = (strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > _WEAK * strength.max())
    rows, columns = np.nonzero(peak & (strength > 0))
    order = np.argsort(-strength[rows, columns], kind="stable")
    chosen = [np.asarray(point, float) for point in taken]
    before = len(chosen)
    for x, y in np.stack([columns, rows], axis=-1)[order]:
        if len(chosen) - before >= count:
            break
        if not chosen or np.min(np.sum((np.array(chosen) - (x, y)) ** 2, axis=1)) >= spacing**2:
            chosen.append(np.array([x, y], float))
    return np.array(chosen[before:]).reshape(-1, 2)
