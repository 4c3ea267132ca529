"""Total variation flow: smoothing that keeps edges, and the local scale of an image from its speed."""

import numpy as np

from marey.arrays import Floats
from marey.compiled.kernels import kernel

FLAT = 1.0
"""Gradient below which the flow is ordinary diffusion, added in quadrature [units of the channels per px]. Chosen by
hand: below the noise of 8-bit images."""
LARGEST_SCALE = 1000.0
"""Scale of a region without any structure [px]."""


def tv_flow(channels: Floats, *, step: float, steps: int) -> Floats:
    """Smooth channels by total variation flow, coupled by a common diffusivity [Brox2003].

    The flow is du/dt = div(grad u / |grad u|), where |grad u|^2 is the sum over the channels, so that an edge in one
    channel stops the smoothing of all. It is integrated by additive operator splitting, which is stable at any step.

    Args:
        channels: (C, H, W) float32.
        step: Time step; a disc of radius r and height h is removed after the time h r / 2.
        steps: Number of steps.

    Returns:
        (C, H, W) float32 smoothed channels, with the mean of each channel preserved.
    """
    smooth = np.array(channels, np.float32, order="C")
    for _ in range(steps):
        smooth = _step(smooth, np.float32(step), np.float32(FLAT**2))
    return smooth


def local_scale(grey: Floats, *, step: float, steps: int) -> Floats:
    """Measure the size of the structures about each pixel by the speed of total variation flow [Brox2004].

    Under the flow a region changes with a speed of perimeter over area, until it joins its surroundings. The mean
    speed of a pixel is therefore the reciprocal of its local scale. The paper divides by the time in which a pixel
    moves. Unlike the paper, the mean is weighted by the speed itself, which needs no limit between motion and rest.

    Args:
        grey: (H, W) float32 image.
        step: Time step.
        steps: Number of steps.

    Returns:
        (H, W) float32 scale [px]: the reciprocal of the mean speed, at most `LARGEST_SCALE`.
    """
    image = np.array(grey, np.float32, order="C")[None]
    moved, squared = np.zeros_like(image), np.zeros_like(image)
    for _ in range(steps):
        after = _step(image, np.float32(step), np.float32(FLAT**2))
        change = np.abs(after - image)
        moved += change
        squared += change * change
        image = after
    speed = squared[0] / np.maximum(np.float32(step) * moved[0], np.float32(1e-9))
    return np.asarray(1.0 / np.maximum(speed, np.float32(1 / LARGEST_SCALE)))


def diffusivity(channels: Floats) -> Floats:
    """Return 1 / |grad u| at each pixel (H, W) of channels (C, H, W).

    The squared gradient is the mean of those of the differences to both sides: unlike the central difference, these
    are not zero in a stripe of one pixel.
    """
    return np.asarray(_diffusivity(np.ascontiguousarray(channels, np.float32), np.float32(FLAT**2)))


@kernel(fastmath=True, error_model="numpy")
def _diffusivity(channels, floor):
    count, height, width = channels.shape
    found = np.empty((height, width), np.float32)
    half = np.float32(0.5)
    for y in range(height):
        row = found[y]
        row[:] = floor
        for c in range(count):
            above, here, below = channels[c, max(y - 1, 0)], channels[c, y], channels[c, min(y + 1, height - 1)]
            for x in range(width):
                up, down = here[x] - above[x], below[x] - here[x]
                row[x] += half * (up * up + down * down)
            for x in range(width - 1):
                across = here[x + 1] - here[x]
                row[x] += half * across * across
                row[x + 1] += half * across * across
        for x in range(width):
            row[x] = np.float32(1.0) / np.sqrt(row[x])
    return found


@kernel(fastmath=True, error_model="numpy")
def _step(channels, step, floor):
    """Return the mean of one implicit step along the rows and one along the columns, each of twice the step."""
    count, height, width = channels.shape
    conduct = _diffusivity(channels, floor)
    result = np.empty_like(channels)
    _solve_columns(channels, conduct, step, result)
    # Along a row, each number depends on the one before. In the transposed image, a processor computes the numbers of
    # several rows at a time.
    turned, turned_conduct = np.empty((count, width, height), np.float32), np.empty((width, height), np.float32)
    solved = np.empty((count, width, height), np.float32)
    _transpose(conduct, turned_conduct)
    for c in range(count):
        _transpose(channels[c], turned[c])
    _solve_columns(turned, turned_conduct, step, solved)
    half = np.float32(0.5)
    for c in range(count):
        for y in range(0, height, _BLOCK):
            for x in range(0, width, _BLOCK):
                for i in range(y, min(y + _BLOCK, height)):
                    for j in range(x, min(x + _BLOCK, width)):
                        result[c, i, j] = half * (result[c, i, j] + solved[c, j, i])
    return result


_BLOCK = 16
"""Side of the squares in which an image is transposed [px]: their rows and columns fit into the fastest cache.
Chosen by hand."""


@kernel
def _transpose(image, turned):
    """Write an image (H, W) with rows and columns exchanged."""
    height, width = image.shape
    for y in range(0, height, _BLOCK):
        for x in range(0, width, _BLOCK):
            for j in range(x, min(x + _BLOCK, width)):
                for i in range(y, min(y + _BLOCK, height)):
                    turned[j, i] = image[i, j]


@kernel(fastmath=True, error_model="numpy")
def _solve_columns(channels, conduct, step, result):
    """Write one implicit step of twice the step along the columns, by the Thomas algorithm.

    The elimination depends on the diffusivity alone and is shared by the channels.
    """
    count, height, width = channels.shape
    one = np.float32(1.0)
    upper, inverse = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    links, before = np.zeros((height, width), np.float32), np.zeros(width, np.float32)
    for y in range(height):
        link = links[y]
        if y < height - 1:
            for x in range(width):
                link[x] = step * (conduct[y, x] + conduct[y + 1, x])
        for x in range(width):
            diagonal = one + before[x] + link[x]
            if y > 0:
                diagonal -= before[x] * upper[y - 1, x]
            inverse[y, x] = one / diagonal
            upper[y, x] = link[x] * inverse[y, x]
            before[x] = link[x]
    for c in range(count):
        lines, source = result[c], channels[c]
        for x in range(width):
            lines[0, x] = source[0, x] * inverse[0, x]
        for y in range(1, height):
            for x in range(width):
                lines[y, x] = (source[y, x] + links[y - 1, x] * lines[y - 1, x]) * inverse[y, x]
        for y in range(height - 2, -1, -1):
            for x in range(width):
                lines[y, x] += upper[y, x] * lines[y + 1, x]
