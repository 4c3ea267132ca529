"""Texture of an image: the smoothed structure tensor and the local scale, as cells of a histogram."""

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers
from marey.compiled.kernels import kernel
from marey.images.features.tv_flow import local_scale, tv_flow

SCALE_STEP, SCALE_STEPS = 6.0, 4
"""Step and number of steps of the flow whose speed is the local scale. Chosen by hand."""
SMOOTH_STEP, SMOOTH_STEPS = 8.0, 2
"""Step and number of steps of the flow that smooths the structure tensor and the scale. Chosen by hand."""
SPEED_WEIGHT = 60.0
"""Weight of the speed of the flow beside the tensor's square root, in grey levels, in the common diffusivity. Chosen by
hand: both then have similar ranges."""
CONTRAST_CUTS = (2.0, 3.0, 4.2, 6.0, 8.5, 12.0, 17.0, 24.0, 34.0)
"""Limits between the classes of contrast [grey levels per px]: a factor of about the square root of 2 apart."""
SCALE_CUTS = (2.8, 4.0, 5.6, 8.0, 12.0)
"""Limits between the classes of scale [px of the halved image]."""
COHERENCE_CUTS = (0.35, 0.6)
"""Limits between the classes of coherence."""
CLASSES = (len(CONTRAST_CUTS) + 1, len(SCALE_CUTS) + 1, len(COHERENCE_CUTS) + 1)
"""Number of classes of contrast, scale and coherence."""
CELLS = CLASSES[0] * CLASSES[1] * CLASSES[2]
"""Number of cells of a texture density."""


def root_tensor(image: Image | Floats) -> Floats:
    """Compute the square root of the structure tensor of an image, summed over its channels.

    The tensor is the sum of the outer products of the channels' gradients. Its square root [Brox2004] has the range of
    the gradient instead of its square.

    Args:
        image: (H, W, C).

    Returns:
        (3, H, W) float32 components xx, yy and xy [grey levels per px].
    """
    xx, yy, xy = np.zeros((3, *image.shape[:2]), np.float32)
    for c in range(image.shape[2]):
        level = np.ascontiguousarray(image[..., c], np.float32)
        across, down = (cv2.Sobel(level, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1)))
        xx, yy, xy = xx + across * across, yy + down * down, xy + across * down
    # The root of a 2 x 2 matrix M is (M + sqrt(det M) I) / sqrt(tr M + 2 sqrt(det M)).
    root = np.sqrt(np.maximum(xx * yy - xy * xy, 0))
    below = np.sqrt(np.maximum(xx + yy + 2 * root, 1e-6))
    return np.stack([(xx + root) / below, (yy + root) / below, xy / below])


def texture_channels(image: Image) -> Floats:
    """Compute contrast, scale and coherence of the texture about each pixel of an image.

    The root of the structure tensor and the speed of total variation flow are smoothed by a flow of their own, which
    keeps the borders between textures ([Brox2003], [Brox2004]). Unlike the papers, the channels are invariants of the
    tensor, since a part of the body is seen in every orientation: trace, and difference of the eigenvalues over trace.

    Args:
        image: (H, W, C) uint8.

    Returns:
        (3, H, W) float32: contrast [grey levels per px], scale [px], coherence from 0 to 1.
    """
    mean_of_channels = np.full((1, image.shape[2]), 1 / image.shape[2])
    grey: Floats = np.asarray(cv2.transform(np.asarray(image, np.float32), mean_of_channels), np.float32)
    scale = local_scale(grey, step=SCALE_STEP, steps=SCALE_STEPS)
    rough = np.concatenate([root_tensor(image), (SPEED_WEIGHT / scale)[None]])
    xx, yy, xy, speed = tv_flow(rough, step=SMOOTH_STEP, steps=SMOOTH_STEPS)
    contrast = xx + yy
    apart = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
    return np.stack([contrast, SPEED_WEIGHT / np.maximum(speed, 1e-3), apart / np.maximum(contrast, 1e-3)])


def texture_cells(image: Image) -> Integers:
    """Return the cell of each pixel's texture (H, W) uint8, computed in the image of half width and height."""
    size = image.shape[1], image.shape[0]
    return np.asarray(cv2.resize(halved_texture_cells(image), size, interpolation=cv2.INTER_NEAREST))


def halved_texture_cells(image: Image) -> Integers:
    """Return the cells of the textures in the image of half width and height, rounded up, uint8."""
    height, width = image.shape[:2]
    small = cv2.resize(image, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA)
    channels = texture_channels(np.asarray(small, np.uint8).reshape(*small.shape[:2], -1))
    return np.asarray(
        _cells(channels, *(np.array(cuts, np.float32) for cuts in (CONTRAST_CUTS, SCALE_CUTS, COHERENCE_CUTS)))
    )


@kernel
def _cells(channels, *cuts):
    kinds, height, width = channels.shape
    cells = np.empty((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            cell = 0
            for k in range(kinds):
                own, place = cuts[k], 0
                while place < len(own) and channels[k, y, x] >= own[place]:
                    place += 1
                cell = cell * (len(own) + 1) + place
            cells[y, x] = cell
    return cells


def texture_density(cells: Integers, region: Integers | np.ndarray) -> Floats:
    """Estimate the density of the texture cells in a region: a histogram, smoothed over neighbouring classes.

    Args:
        cells: (H, W) cells of the pixels.
        region: (H, W) true inside.

    Returns:
        (CELLS,) float32, sums to one; uniform if the region is empty.
    """
    counts = np.bincount(cells[region], minlength=CELLS).astype(np.float32)
    total = counts.sum()
    if total == 0:
        return np.full(CELLS, 1.0 / CELLS, np.float32)
    return np.asarray(smoothed_counts(counts) / total)


def smoothed_counts(counts: Floats) -> Floats:
    """Smooth counts (..., CELLS) by the weights 1, 2, 1 along each kind of class; their sum is preserved."""
    cube = np.asarray(counts, np.float32).reshape(*counts.shape[:-1], *CLASSES)
    for axis in range(-3, 0):
        last = cube.shape[axis] - 1
        before = np.take(cube, [0, *range(last)], axis)
        after = np.take(cube, [*range(1, last + 1), last], axis)
        cube = 0.25 * before + 0.5 * cube + 0.25 * after
    return np.asarray(cube.reshape(counts.shape))
