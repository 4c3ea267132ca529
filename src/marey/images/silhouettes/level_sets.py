"""Level-set segmentation: the border of a region is moved until evidence and length are in balance.

The level-set function has only four values: -3 inside, -1 on the inner border, +1 on the outer border, +3 outside.
The two borders form the narrow band, which is kept as two lists of pixels [Shi2008]; a sweep visits only these.
"""

import cv2
import numpy as np

from marey.arrays import Mask
from marey.compiled.kernels import kernel

LENGTH_REACH = 2
"""Half-width of the window over which the border's length is measured [px]. The kernels depend on this value."""
_ROW = 20
"""Number of bits by which the row is shifted in the number of a pixel on a list."""
_COLUMN = (1 << _ROW) - 1
"""Bit mask of the column in the number of a pixel on a list."""


def _length_weights() -> np.ndarray:
    """Return the Gaussian weights (5, 5) of the pixels about a pixel, which has weight zero; they sum to one."""
    offsets = np.arange(-LENGTH_REACH, LENGTH_REACH + 1)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.6**2))
    weights[LENGTH_REACH, LENGTH_REACH] = 0.0
    return np.ascontiguousarray((weights / weights.sum()).astype(np.float32))


WEIGHTS = _length_weights()
"""Weights (5, 5) of a pixel's neighbours in the border's length: a Gaussian with standard deviation 1.6 px."""


def evolve(evidence: np.ndarray, start: Mask, *, length: float, sweeps: int = 200) -> Mask:
    """Move the border of a region to the nearest minimum of [Rosenhahn2006] eq. (1).

    The energy is minus the sum of the evidence inside, plus the border's length. Unlike the paper, there is no gradient
    flow of a smooth function: the pixels beside the border are moved one after the other to the side with the lower
    energy, so that every step lowers the energy and the iteration terminates. Unlike [Shi2008], who alternates between
    evidence and smoothing, each decision uses their sum. The length is measured between pixels up to two apart (weights
    of a Gaussian with standard deviation 1.6 pixels).

    Args:
        evidence: (H, W) float32, log p_inside - log p_outside of each pixel.
        start: (H, W) initial region; pixels neither inside nor beside it stay outside.
        length: Weight of the border's length: the evidence from which on a single pixel differs from its surroundings.
        sweeps: Largest number of sweeps over the border.

    Returns:
        (H, W) true inside the final region.
    """
    inside = np.ascontiguousarray(start, dtype=np.bool_)
    if not inside.any():
        return inside.copy()
    return np.asarray(
        _evolve(np.ascontiguousarray(evidence, dtype=np.float32), inside, np.float32(length), WEIGHTS, sweeps)
    )


def evolve_coarse_to_fine(evidence: np.ndarray, start: Mask | None, *, length: float, halvings: int) -> Mask:
    """Evolve a region in reduced images first, so that it reaches minima that are farther away than the nearest one.

    A coarse pixel's evidence is the mean of its fine pixels' and its sides are longer, so that the weight of the length
    is divided by its size. Before each evolution, pixels whose blurred evidence exceeds this weight change sides.

    Args:
        evidence: (H, W) float32, log p_inside - log p_outside of each pixel.
        start: (H, W) initial region; None for the pixels of the coarsest image whose blurred evidence is positive.
        length: Weight of the border's length in the full image, see `evolve`.
        halvings: Number of times that width and height are halved for the coarsest image.

    Returns:
        (H, W) true inside the final region.
    """
    pyramid = [evidence]
    for _ in range(halvings):
        height, width = pyramid[-1].shape
        pyramid.append(cv2.resize(pyramid[-1], ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA))
    region = np.zeros_like(evidence, bool) if start is None else start
    for level in range(halvings, -1, -1):
        height, width = pyramid[level].shape
        blurred = cv2.GaussianBlur(pyramid[level], (0, 0), 1.0)
        weight = length / 2**level
        if start is None and level == halvings:
            region = blurred > 0
        else:
            scaled = cv2.resize(region.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
            region = (scaled & (blurred > -weight)) | (blurred > weight)
        region = evolve(pyramid[level], region, length=weight)
    return region


def region_energy(evidence: np.ndarray, region: Mask, *, length: float) -> float:
    """Return the energy that `evolve` lowers: minus the sum of the evidence inside, plus the border's length.

    Args:
        evidence: (H, W) log p_inside - log p_outside of each pixel.
        region: (H, W) true inside.
        length: Weight of the border's length, as in `evolve`.

    Returns:
        The energy [nat]; an empty region has zero, and a lower energy explains the image better.
    """
    if not region.any():
        return 0.0
    inside = np.ascontiguousarray(region, np.float32)
    share = cv2.filter2D(inside, cv2.CV_32F, WEIGHTS, borderType=cv2.BORDER_REPLICATE)
    border = float((1.0 - share)[region].sum(dtype=np.float64))
    return length * border - float(evidence[region].sum(dtype=np.float64))


@kernel(fastmath=True)
def _vote(evidence, phi, y, x, length, weights):
    height, width = phi.shape
    share = np.float32(0.0)
    if y >= 2 and x >= 2 and y < height - 2 and x < width - 2:
        for i in range(5):
            for j in range(5):
                share += weights[i, j] * np.float32(phi[y + i - 2, x + j - 2] < 0)
    else:
        for i in range(5):
            row = min(max(y + i - 2, 0), height - 1)
            for j in range(5):
                column = min(max(x + j - 2, 0), width - 1)
                if phi[row, column] < 0:
                    share += weights[i, j]
    return evidence[y, x] + length * (np.float32(2.0) * share - np.float32(1.0))


@kernel(fastmath=True)
def _switch(evidence, phi, stamp, sweep, own, count, other, other_count, side, length, weights):
    """Move a list's pixels with lower energy on the other side; side is +1 for the outer list, -1 for the inner."""
    height, width = phi.shape
    kept, last, moved = 0, count, 0
    for k in range(count):
        y, x = own[k] >> _ROW, own[k] & _COLUMN
        # The decision can only differ from the last one if a pixel within reach has changed since.
        if stamp[y, x] < sweep - 1 or side * _vote(evidence, phi, y, x, length, weights) <= 0:
            own[kept] = own[k]
            kept += 1
            continue
        moved += 1
        phi[y, x] = -side
        for row in range(max(y - 2, 0), min(y + 3, height)):
            for column in range(max(x - 2, 0), min(x + 3, width)):
                stamp[row, column] = sweep
        other[other_count] = own[k]
        other_count += 1
        for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            row, column = y + dy, x + dx
            if 0 <= row < height and 0 <= column < width and phi[row, column] == 3 * side:
                phi[row, column] = side
                own[last] = row << _ROW | column
                last += 1
    for k in range(count, last):
        own[kept] = own[k]
        kept += 1
    return kept, other_count, moved


@kernel(fastmath=True)
def _clean(phi, own, count, side):
    """Remove the pixels of a list that no longer have a neighbour on the other side."""
    height, width = phi.shape
    kept = 0
    for k in range(count):
        y, x = own[k] >> _ROW, own[k] & _COLUMN
        border = (
            (y > 0 and phi[y - 1, x] * side < 0)
            or (y < height - 1 and phi[y + 1, x] * side < 0)
            or (x > 0 and phi[y, x - 1] * side < 0)
            or (x < width - 1 and phi[y, x + 1] * side < 0)
        )
        if border:
            own[kept] = own[k]
            kept += 1
        else:
            phi[y, x] = 3 * side
    return kept


@kernel(fastmath=True)
def _lists(inside, phi, inner, outer):
    height, width = inside.shape
    inner_count, outer_count = 0, 0
    for y in range(height):
        own, line = inside[y], phi[y]
        above, below = inside[max(y - 1, 0)], inside[min(y + 1, height - 1)]
        # Without branches, so that the compiler vectorises the loop.
        for x in range(1, width - 1):
            border = (own[x] ^ above[x]) | (own[x] ^ below[x]) | (own[x] ^ own[x - 1]) | (own[x] ^ own[x + 1])
            line[x] = (1 - 2 * np.int8(own[x])) * (3 - 2 * np.int8(border))
        for x, beside in ((0, min(1, width - 1)), (width - 1, max(width - 2, 0))):
            border = (own[x] ^ above[x]) | (own[x] ^ below[x]) | (own[x] ^ own[beside])
            line[x] = (1 - 2 * np.int8(own[x])) * (3 - 2 * np.int8(border))
        for x in range(width):
            if line[x] == -1:
                inner[inner_count] = y << _ROW | x
                inner_count += 1
            elif line[x] == 1:
                outer[outer_count] = y << _ROW | x
                outer_count += 1
    return inner_count, outer_count


@kernel(fastmath=True)
def _evolve(evidence, inside, length, weights, sweeps):
    height, width = inside.shape
    phi = np.empty((height, width), np.int8)
    # A pixel may be on a list twice during a sweep, hence the capacity.
    inner, outer = np.empty(2 * height * width, np.int64), np.empty(2 * height * width, np.int64)
    inner_count, outer_count = _lists(inside, phi, inner, outer)
    stamp = np.zeros((height, width), np.int16)
    for sweep in range(1, sweeps + 1):
        outer_count, inner_count, joined = _switch(
            evidence, phi, stamp, sweep, outer, outer_count, inner, inner_count, 1, length, weights
        )
        inner_count = _clean(phi, inner, inner_count, -1)
        inner_count, outer_count, left = _switch(
            evidence, phi, stamp, sweep, inner, inner_count, outer, outer_count, -1, length, weights
        )
        outer_count = _clean(phi, outer, outer_count, 1)
        if joined + left == 0:
            break
    result = np.empty((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            result[y, x] = phi[y, x] < 0
    return result
