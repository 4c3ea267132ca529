"""Compiled kernels that take patches from two images and compare them, eight pixels at a time in single precision."""

import math
from typing import NamedTuple

import numpy as np

from marey.compiled.kernels import kernel
from marey.lanes import LANES, interpolate_pixels, place_pixels, put_combination

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""Sums in any order; NaN stays NaN, for it marks missing pixels."""
_BLOCK = 32
"""Number of pixels by which the arrays of a patch grow, so that loops over them have vectors only."""
_GRADIENTS = np.array([0, 1, 0, 0, 1, 1])
"""Gradient in the derivative of the grey values by each parameter: 0 across, 1 down."""
_OFFSETS = np.array([0, 0, 1, 2, 1, 2])
"""Factor of the gradient in it: 0 for 1, 1 for the offset x, 2 for the offset y."""
_SQUARES = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Place of the product of two factors in the result of `_products_with_squares`."""


class PatchWork(NamedTuple):
    """Work arrays for patches of one size; P is the number of pixels, rounded up by `padded_size`."""

    half: int
    """Pixels of the patch from its centre to its edge."""
    offset_x: np.ndarray
    """(P,) float32 offsets of the pixels from the centre [px]; 0 beyond the last pixel."""
    offset_y: np.ndarray
    """(P,) the same along the columns."""
    ones: np.ndarray
    """(P,) float32 ones."""
    first: np.ndarray
    """(P,) int32 index of the coefficient at the upper left of the 4 x 4 coefficients of each mapped pixel."""
    right: np.ndarray
    """(P,) float32 place of the mapped pixel between the columns of coefficients, from 0 to 1."""
    below: np.ndarray
    """(P,) the same between the rows."""
    values: np.ndarray
    """Values of a row of the patch between the rows of coefficients, float32."""
    slopes: np.ndarray
    """Their derivatives along the columns."""


@kernel
def patch_work(half):
    """Return work arrays for patches of one size."""
    side, size = 2 * half + 1, padded_size(half)
    offset_x, offset_y = np.zeros(size, np.float32), np.zeros(size, np.float32)
    for i in range(side):
        for j in range(side):
            offset_x[i * side + j], offset_y[i * side + j] = j - half, i - half
    row = (side + 2 * LANES) // LANES * LANES
    return PatchWork(
        half, offset_x, offset_y, np.ones(size, np.float32), np.zeros(size, np.int32), np.zeros(size, np.float32),
        np.zeros(size, np.float32), np.zeros(row, np.float32), np.zeros(row, np.float32),
    )  # fmt: skip


@kernel
def padded_size(half):
    """Return the length of arrays for the pixels of a patch, in which the last row may be exceeded by a vector."""
    return ((2 * half + 1) ** 2 + LANES + _BLOCK - 2) // _BLOCK * _BLOCK


class TemplatePatch(NamedTuple):
    """A patch of the template, and what it needs to be compared; computed once for all steps.

    The parameters are the shifts x and y or, with them, the linear part of the map, row by row. The derivatives of the
    grey values by the linear part are the gradients times the offsets, and are not stored.
    """

    grey: np.ndarray
    """(P,) float32 grey values less their mean; 0 beyond the last pixel."""
    across: np.ndarray
    """(P,) float32 their gradient along the rows [1/px]; 0 beyond the last pixel."""
    down: np.ndarray
    """(P,) the same along the columns."""
    shares: np.ndarray
    """(2 or 6,) multiple of the grey values that each derivative contains."""
    normal: np.ndarray
    """(2 or 6, 2 or 6) normal matrix of the derivatives, less what gain and offset explain of them."""


@kernel
def template_patch(half, count):
    """Return arrays for a patch of the template.

    Args:
        half: pixels from the centre to the edge.
        count: 6 where the whole affine map is sought, 2 where the shift alone.
    """
    size = padded_size(half)
    return TemplatePatch(
        np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32), np.empty(count),
        np.empty((count, count)),
    )  # fmt: skip


@kernel
def _cubic(t):
    """Return the four B-splines' values at a fraction of a pixel."""
    s = np.float32(1.0) - t
    sixth, half, third = np.float32(1 / 6), np.float32(0.5), np.float32(2 / 3)
    return sixth * s * s * s, third + (half * t - np.float32(1)) * t * t, \
        third + (half * s - np.float32(1)) * s * s, sixth * t * t * t  # fmt: skip


@kernel
def _cubic_slopes(t):
    s = np.float32(1.0) - t
    half, more = np.float32(0.5), np.float32(1.5)
    return -half * s * s, (more * t - np.float32(2)) * t, (np.float32(2) - more * s) * s, half * t * t


@kernel
def take_template(picture, x, y, work, patch):
    """Take a patch of the template.

    Args:
        picture: (H, W) coefficients.
        x: of the centre [px].
        y: of the centre [px].
        work: result of `patch_work`.
        patch: result of `template_patch`, which is filled.

    Returns:
        The mean grey value, and the sum of squares about it.
    """
    size, shares, normal = (2 * work.half + 1) ** 2, patch.shares, patch.normal
    _take_values(picture, x, y, work, patch)
    mean = _centre(patch.grey, size)
    for at in range(size, patch.grey.shape[0]):
        patch.across[at] = patch.down[at] = np.float32(0.0)
    energy, means = _product(patch.grey, patch.grey), np.empty(shares.shape[0])
    if shares.shape[0] == 2:
        means[0], means[1] = _product(patch.across, work.ones), _product(patch.down, work.ones)
        shares[0], shares[1] = _product(patch.across, patch.grey), _product(patch.down, patch.grey)
        normal[0, 0], normal[1, 1] = _product(patch.across, patch.across), _product(patch.down, patch.down)
        normal[1, 0] = _product(patch.across, patch.down)
    else:
        means[0], means[2], means[3] = _products_with_offsets(patch.across, work.ones, work)
        means[1], means[4], means[5] = _products_with_offsets(patch.down, work.ones, work)
        shares[0], shares[2], shares[3] = _products_with_offsets(patch.across, patch.grey, work)
        shares[1], shares[4], shares[5] = _products_with_offsets(patch.down, patch.grey, work)
        _write_normal(patch, work)
    for k in range(shares.shape[0]):
        means[k] /= size
        shares[k] /= max(energy, 1e-300)
        for m in range(k + 1):
            # The mean and the share of the grey values are orthogonal.
            normal[k, m] -= size * means[k] * means[m] + energy * shares[k] * shares[m]
            normal[m, k] = normal[k, m]
    return mean, energy


@kernel
def _write_normal(patch, work):
    """Write the lower half of the products of all derivatives, those by the linear part included."""
    normal, weight = patch.normal, np.empty((3, 6))
    for k in range(3):
        one, other = patch.across if k < 2 else patch.down, patch.across if k == 0 else patch.down
        numbers = _products_with_squares(one, other, work)
        for m in range(6):
            weight[k, m] = numbers[m]
    for k in range(6):
        for m in range(k + 1):
            normal[k, m] = weight[_GRADIENTS[k] + _GRADIENTS[m], _SQUARES[_OFFSETS[k], _OFFSETS[m]]]


@kernel(fastmath=FAST)
def _take_values(picture, x, y, work, patch):
    """Write values and gradients of a patch aligned with the pixel axes."""
    half, grey, across, down = work.half, patch.grey, patch.across, patch.down
    side, width = 2 * half + 1, picture.shape[1]
    column, row = math.floor(x), math.floor(y)
    right, below = np.float32(x - column), np.float32(y - row)
    x_taps, x_slopes, y_taps, y_slopes = _cubic(right), _cubic_slopes(right), _cubic(below), _cubic_slopes(below)
    flat, whole = picture.reshape(picture.size), (side + 3) // LANES * LANES
    first = (int(row) - half - 1) * width + int(column) - half - 1
    for i in range(side):
        for j in range(0, whole, LANES):
            put_combination(work.values, j, y_taps, flat, first + j, width)
            put_combination(work.slopes, j, y_slopes, flat, first + j, width)
        for j in range(whole, side + 3):
            work.values[j] = _combined(y_taps, flat, first + j, width)
            work.slopes[j] = _combined(y_slopes, flat, first + j, width)
        # What a vector writes beyond its row is overwritten by the next row, or not used.
        for j in range(0, side, LANES):
            put_combination(grey, i * side + j, x_taps, work.values, j, 1)
            put_combination(across, i * side + j, x_slopes, work.values, j, 1)
            put_combination(down, i * side + j, x_taps, work.slopes, j, 1)
        first += width


@kernel(fastmath=FAST)
def _combined(taps, flat, first, step):
    """Return the sum of four pixels, weighted."""
    a, b, c, d = flat[first], flat[first + step], flat[first + 2 * step], flat[first + 3 * step]
    return taps[0] * a + taps[1] * b + taps[2] * c + taps[3] * d


@kernel(fastmath=FAST)
def _centre(numbers, size):
    """Subtract the mean of the first numbers from them, set the others to 0, and return the mean."""
    for at in range(size, numbers.shape[0]):
        numbers[at] = np.float32(0.0)
    total = np.float32(0.0)
    for at in range(numbers.shape[0] // _BLOCK * _BLOCK):
        total += numbers[at]
    mean = total / np.float32(size)
    for at in range(numbers.shape[0] // _BLOCK * _BLOCK):
        numbers[at] -= mean
    for at in range(size, numbers.shape[0]):
        numbers[at] = np.float32(0.0)
    return mean


@kernel(fastmath=FAST)
def _product(one, other):
    """Return the scalar product of two padded arrays of float32."""
    total = np.float32(0.0)
    for at in range(one.shape[0] // _BLOCK * _BLOCK):
        total += one[at] * other[at]
    return float(total)


@kernel(fastmath=FAST)
def _products_with_offsets(one, other, work):
    """Return the sums of the products of two padded arrays times 1, x and y, the offsets of their pixels."""
    total, with_x, with_y = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for at in range(one.shape[0] // _BLOCK * _BLOCK):
        number = one[at] * other[at]
        total += number
        with_x += number * work.offset_x[at]
        with_y += number * work.offset_y[at]
    return float(total), float(with_x), float(with_y)


@kernel(fastmath=FAST)
def _products_with_squares(one, other, work):
    """Return the sums of the products of two padded arrays times 1, x, y, x x, x y and y y."""
    total, with_x, with_y = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    with_xx, with_xy, with_yy = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for at in range(one.shape[0] // _BLOCK * _BLOCK):
        x, y, number = work.offset_x[at], work.offset_y[at], one[at] * other[at]
        along, down = number * x, number * y
        total += number
        with_x += along
        with_y += down
        with_xx += along * x
        with_xy += along * y
        with_yy += down * y
    return float(total), float(with_x), float(with_y), float(with_xx), float(with_xy), float(with_yy)


@kernel
def take_search(picture, to_search, work, found):
    """Write the search image's values at the mapped pixels of the patch, less their mean; return the mean.

    The places of all pixels are computed first, so that the processor need not wait for one before it reads the next.

    Args:
        picture: (H, W) coefficients.
        to_search: (6,) the map: place of the centre [px], and the linear part row by row.
        work: result of `patch_work`.
        found: (P,) float32 for the values; 0 beyond the last pixel.
    """
    height, width = picture.shape
    size, flat = (2 * work.half + 1) ** 2, picture.reshape(height * width)
    place_patch(to_search, height, width, work)
    for at in range(0, size, LANES):
        interpolate_pixels(flat, width, work.first, work.right, work.below, at, found)
    return _centre(found, size)


@kernel
def place_patch(to_search, height, width, work):
    """Find the coefficients of the mapped pixels of a patch, relative to the centre's pixel, for single precision."""
    u, v, a, b, c, d = to_search
    column, row = math.floor(u), math.floor(v)
    near = (
        np.float32(u - column), np.float32(v - row), np.float32(a), np.float32(b), np.float32(c), np.float32(d),
    )  # fmt: skip
    corner, last = (int(row) - 1) * width + int(column) - 1, (height - 3) * width - 4
    for at in range(0, (2 * work.half + 1) ** 2, LANES):
        place_pixels(
            near, corner, width, last, work.offset_x, work.offset_y, at, work.first, work.right, work.below
        )  # fmt: skip


@kernel
def compare(patch, work, found, projected):
    """Project the found values on the template's derivatives; return their product with the template and energy.

    The found values have the mean 0, so that the means of the derivatives do not matter.
    """
    along, power = _product(found, patch.grey), _product(found, found)
    if projected.shape[0] == 2:
        projected[0], projected[1] = _product(found, patch.across), _product(found, patch.down)
    else:
        projected[0], projected[2], projected[3] = _products_with_offsets(found, patch.across, work)
        projected[1], projected[4], projected[5] = _products_with_offsets(found, patch.down, work)
    for k in range(projected.shape[0]):
        projected[k] -= patch.shares[k] * along
    return along, power
