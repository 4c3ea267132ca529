"""Placement of a silhouette's border to the pixel: a border pixel is assigned to the side whose colour it resembles."""

import cv2
import numpy as np

from marey.arrays import Mask
from marey.compiled.kernels import kernel
from marey.images.silhouettes.evidence import LIMIT

# Constants rather than a settings record: the kernels are compiled with them.
NEAR_BORDER = 4
"""Half-width of the window about a border pixel from which the colours of the two sides are taken, every second pixel
[px]. Chosen by hand."""

CONTRAST = 3.0
"""Least difference between the colours of the two sides for which the border is moved [standard deviations]. Chosen by
hand."""


def edge_evidence(
    picture: np.ndarray, light: np.ndarray, noise: np.ndarray, votes: np.ndarray, region: Mask
) -> np.ndarray:
    """Evaluate pixels near the border against the local colours of both sides.

    A pixel half covered by the person already differs from the background: with the evidence alone the border lies
    outside the true one, farther if the optics blur or the recording stores colour at half the resolution. Here the
    colour F of the person (mean of the near pixels two or more inside) and B of the background (its own mean, darkened
    like near pixels outside) are means of normal densities of equal width, so that the border lies where
    image = (F + B) / 2.

    Args:
        picture: (H, W, C) uint8 image.
        light: (H, W, C) background with the exposure of this image.
        noise: (C,) standard deviation [grey levels].
        votes: (H, W) evidence so far.
        region: (H, W) region of the person so far.

    Returns:
        (H, W) float32 evidence, changed only within two pixels of the border.
    """
    square = np.ones((5, 5), np.uint8)
    mask = region.view(np.uint8)
    core = cv2.erode(mask, square, borderType=cv2.BORDER_REPLICATE)
    near = cv2.dilate(mask, square, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(_edge_evidence(picture, light, tuple(1 / noise**2), votes, cv2.add(core, near)))


@kernel(fastmath=True, error_model="numpy")
def _edge_evidence(picture, light, weight, votes, zone):
    # The weights are a tuple, whose length is known at compile time, so that the loops over channels are unrolled.
    (height, width), channels = zone.shape, len(weight)
    result = votes.copy()
    inside, limit = np.empty(channels, np.int64), np.float32(LIMIT)
    for y in range(height):
        for x in range(width):
            if zone[y, x] != 1:
                continue
            count, above, below = 0, np.float32(0.0), np.float32(0.0)
            for c in range(channels):
                inside[c] = 0
            for row in range(max(y - NEAR_BORDER, y % 2), min(y + NEAR_BORDER + 1, height), 2):
                for column in range(max(x - NEAR_BORDER, x % 2), min(x + NEAR_BORDER + 1, width), 2):
                    side = zone[row, column]
                    if side == 2:
                        count += 1
                        for c in range(channels):
                            inside[c] += picture[row, column, c]
                    elif side == 0:
                        for c in range(channels):
                            level = light[row, column, c]
                            above += level * np.float32(picture[row, column, c])
                            below += level * level
            if count == 0 or below == 0:
                continue
            share, shade = np.float32(1.0) / np.float32(count), above / below
            contrast, lean = np.float32(0.0), np.float32(0.0)
            for c in range(channels):
                own, rest = np.float32(inside[c]) * share, shade * light[y, x, c]
                contrast += weight[c] * (own - rest) ** 2
                lean += weight[c] * (own - rest) * (np.float32(picture[y, x, c]) - np.float32(0.5) * (own + rest))
            if contrast > np.float32(CONTRAST**2):
                result[y, x] = min(max(lean, -limit), limit)
    return result
