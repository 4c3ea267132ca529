"""Points worth following: corners, spread over a picture, and places along edges between them."""

import cv2
import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import SettingProblem

_WEAK = 0.01
"""Corners and edges below this share of the picture's strongest are left out."""
_NARROW = 0.2
"""The weaker direction of an edge has at most this share of the stronger one's square gradient."""


def good_features(
    image: np.ndarray, *, count: int, spacing: float = 8.0, size: int = 13, within: Mask | None = None
) -> Floats:
    """Choose corners: where the patch's square gradient is large in its weakest direction ([Shi1994]).

    Args:
        image: (H, W) grey.
        count: How many at most.
        spacing: Least distance between two of them [px].
        size: Width and height of the patches that will be followed [px], odd.
        within: (H, W) where points may lie; everywhere when None.

    Returns:
        (n, 2) the strongest first [px]; fewer than `count` where the picture has no more.

    Raises:
        SettingProblem: The picture is not a grey one, or a number is impossible.
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
    """Choose places along edges, where only the movement across the edge can be seen ([Irani1999]).

    Args:
        image: (H, W) grey.
        count: How many at most.
        taken: (n, 2) points that are followed already [px].
        spacing: Least distance from them, and between two of the new ones [px].
        size: Width and height of the patches that will be followed [px], odd.
        within: (H, W) where points may lie; everywhere when None.

    Returns:
        (n, 2) the strongest first [px]; fewer than `count` where the picture has no more.

    Raises:
        SettingProblem: The picture is not a grey one, or a number is impossible.
    """
    weakest, strongest = _square_gradients(image, size)
    along_edge = np.where(weakest <= _NARROW * strongest, strongest, 0)
    return _spread_out(_allowed(along_edge, size, within), count, spacing, taken)


def _square_gradients(image: np.ndarray, size: int) -> tuple[Floats, Floats]:
    """Give the mean square gradient of each patch in its weakest and its strongest direction (H, W) [grey2/px2]."""
    if image.ndim != 2:
        raise SettingProblem(f"A picture of shape {image.shape} is no grey one (height, width).")
    if size < 3 or size % 2 == 0:
        raise SettingProblem(f"A patch of {size} pixels is impossible; it has an odd number from 3 up.")
    grey = np.asarray(image, np.float32)
    across, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(grey, cv2.CV_32F, 0, 1) / 8
    xx, yy, xy = (cv2.blur(product, (size, size)) for product in (across**2, down**2, across * down))
    middle, apart = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return middle - apart, middle + apart


def _allowed(strength: Floats, size: int, within: Mask | None) -> Floats:
    """Clear what lies too near to the border for a patch, or where no point may lie."""
    margin = size // 2 + 3
    kept = np.zeros_like(strength)
    inner = (slice(margin, -margin), slice(margin, -margin))
    kept[inner] = strength[inner]
    return kept if within is None else np.where(within, kept, 0)


def _spread_out(strength: Floats, count: int, spacing: float, taken: Floats) -> Floats:
    """Take the strongest place, then the strongest of those far enough from all taken ones, and so on."""
    if count < 0 or not spacing > 0:
        raise SettingProblem(f"{count} points {spacing:g} px apart cannot be chosen.")
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
