"""The last pixel: a pixel on the border shows some of both sides, and belongs to the side it shows more of."""

import cv2
import numba
import numpy as np

from marey.arrays import Mask
from marey.images.evidence import LIMIT

NEAR = 4
"""Pixels about a border pixel from which the colours of the two sides are taken, every second one."""

CONTRAST = 3.0
"""Where the sides differ by fewer standard deviations than this the border stays where it is."""


def edge_evidence(
    picture: np.ndarray, light: np.ndarray, noise: np.ndarray, votes: np.ndarray, region: Mask
) -> np.ndarray:
    """Evidence in which the pixels beside the border compare with the colours of both sides at that place.

    A pixel half covered by the person already is no background: with the evidence alone the border lies outside the
    true one, farther where the optics blur and where the recording stores colour at half the resolution. Here the
    colour F of the person (mean of the near pixels two or more inside) and B of the background (its own mean,
    darkened as near pixels outside are) are normal densities of one width, so that the border lies where picture = (F
    + B) / 2.

    Args:
        picture: (H, W, C) uint8.
        light: (H, W, C) the background as this picture exposes it.
        noise: (C,) standard deviation in grey levels.
        votes: (H, W) the evidence so far.
        region: (H, W) the person so far.

    Returns:
        (H, W) float32 evidence, changed only within two pixels of the border.
    """
    square = np.ones((5, 5), np.uint8)
    mask = region.astype(np.uint8)
    core = cv2.erode(mask, square, borderType=cv2.BORDER_REPLICATE)
    near = cv2.dilate(mask, square, borderType=cv2.BORDER_REPLICATE)
    zone = (core + near).astype(np.uint8)
    return _edge_evidence(picture, light, 1 / noise**2, votes, zone)


@numba.njit(cache=True, nogil=True)
def _edge_evidence(picture, light, weight, votes, zone):
    height, width, channels = picture.shape
    result = votes.copy()
    inside, limit = np.empty(channels, np.float32), np.float32(LIMIT)
    enough = np.float32(CONTRAST**2)
    for y in range(height):
        for x in range(width):
            if zone[y, x] != 1:
                continue
            inside[:] = 0
            count, above, below = 0, np.float32(0.0), np.float32(0.0)
            for row in range(max(y - NEAR, y % 2), min(y + NEAR + 1, height), 2):
                for column in range(max(x - NEAR, x % 2), min(x + NEAR + 1, width), 2):
                    if zone[row, column] == 2:
                        count += 1
                        for c in range(channels):
                            inside[c] += picture[row, column, c]
                    elif zone[row, column] == 0:
                        for c in range(channels):
                            level = light[row, column, c]
                            above += level * np.float32(picture[row, column, c])
                            below += level * level
            if count == 0 or below == 0:
                continue
            shade, contrast, lean = above / below, np.float32(0.0), np.float32(0.0)
            for c in range(channels):
                own, rest = inside[c] / count, shade * light[y, x, c]
                contrast += weight[c] * (own - rest) ** 2
                lean += weight[c] * (own - rest) * (np.float32(picture[y, x, c]) - np.float32(0.5) * (own + rest))
            if contrast > enough:
                result[y, x] = min(max(lean, -limit), limit)
    return result
