"""Compiled kernels of `marey.images.matching.matching`, which process one patch after the other."""

import math
from typing import NamedTuple

import numpy as np

from marey.compiled.kernels import kernel
from marey.lanes import LANES, interpolate_pixels, place_pixels, put_combination

CONVERGED, LEFT_PICTURE, TEXTURELESS, DEGENERATE, STRAYED, UNLIKE, UNFINISHED, MISSING = range(8)
"""Outcome of the matching of a patch, described by `marey.images.matching.matching.Outcome`."""

_BOUNDED = 2.0
"""Largest displacement of the patch in one step, root mean square over its pixels [px]. Chosen by hand."""
_STIFF = 1e6
"""Weight of the constraint of a step to its line, relative to the information of the grey values. Chosen by hand."""
_FAST = {"reassoc", "contract", "arcp", "nsz"}
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
        half, offset_x, offset_y, np.zeros(size, np.int32), np.zeros(size, np.float32), np.zeros(size, np.float32),
        np.zeros(row, np.float32), np.zeros(row, np.float32),
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
def match_patches(template, search, pixels, maps, lines, constrained, half, count, options, quality, outcomes):
    """Match patches one after the other, see `marey.images.matching.matching.match`.

    Args:
        template: (H, W) float32 coefficients of the template's spline.
        search: (h, w) those of the search image.
        pixels: (n, 2) the patches' centres in the template.
        maps: (n, 6) u, v and the linear part, row by row; the start, overwritten by the result.
        lines: (n, 2) unit directions of the lines through the starts on which the centres stay.
        constrained: whether they do.
        half: pixels from a patch's centre to its edge.
        count: 6 where the whole affine map is sought, 2 where the shift alone.
        options: (steps, precision [px], reach [px], stretch, least square gradient [grey2/px2], a pixel's variance).
        quality: (n, 8) for what is found: variances of x, y and covariance [px2], correlation, gain, offset, noise,
            steps.
        outcomes: (n,) int8.
    """
    work, patch = patch_work(half), template_patch(half, count)
    found, factor = np.empty(padded_size(half), np.float32), np.empty((count, count))
    for i in range(pixels.shape[0]):
        quality[i] = np.nan
        quality[i, 7] = 0
        x, y = pixels[i]
        if not (_finite(maps[i]) and math.isfinite(x + y) and (not constrained or _finite(lines[i]))):
            outcomes[i] = MISSING
        elif not _within(template, x, y, half, half):
            outcomes[i] = LEFT_PICTURE
        else:
            mean, energy = take_template(template, x, y, work, patch)
            outcomes[i] = _unusable(
                patch.normal, (2 * half + 1) ** 2, maps[i], lines[i], constrained, options[4], energy
            )
            if outcomes[i] == CONVERGED:
                outcomes[i] = _iterate(
                    search, x, y, maps[i], lines[i], constrained, options, work, patch, mean, energy, factor, found,
                    quality[i],
                )  # fmt: skip


@kernel
def _finite(numbers):
    total = 0.0
    for number in numbers:
        total += number
    return math.isfinite(total)


@kernel
def _within(picture, x, y, wide, high):
    """Return whether the spline is defined in the whole box about a position."""
    height, width = picture.shape
    return x - wide >= 1 and y - high >= 1 and x + wide < width - 2 and y + high < height - 2


@kernel
def _unusable(normal, size, to_search, line, constrained, least, energy):
    """Return why a template cannot be matched, or CONVERGED if it can."""
    across, both, down = normal[0, 0] / size, normal[0, 1] / size, normal[1, 1] / size
    if not math.isfinite(across + down + energy):
        return MISSING
    weakest = 0.5 * (across + down - math.sqrt((across - down) ** 2 + 4 * both**2))
    if constrained:
        x = to_search[5] * line[0] - to_search[3] * line[1]
        y = to_search[2] * line[1] - to_search[4] * line[0]
        weakest = (across * x * x + 2 * both * x * y + down * y * y) / (x * x + y * y + 1e-300)
    return TEXTURELESS if weakest <= least or energy <= 0 else CONVERGED


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
        means[0], means[1] = _sum(patch.across), _sum(patch.down)
        shares[0], shares[1] = _product(patch.across, patch.grey), _product(patch.down, patch.grey)
        normal[0, 0], normal[1, 1] = _product(patch.across, patch.across), _product(patch.down, patch.down)
        normal[1, 0] = _product(patch.across, patch.down)
    else:
        means[0], means[2], means[3] = _sums_with_offsets(patch.across, work)
        means[1], means[4], means[5] = _sums_with_offsets(patch.down, work)
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


@kernel(fastmath=_FAST)
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


@kernel(fastmath=_FAST)
def _combined(taps, flat, first, step):
    """Return the sum of four pixels, weighted."""
    a, b, c, d = flat[first], flat[first + step], flat[first + 2 * step], flat[first + 3 * step]
    return taps[0] * a + taps[1] * b + taps[2] * c + taps[3] * d


@kernel(fastmath=_FAST)
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


@kernel(fastmath=_FAST)
def _sum(numbers):
    """Return the sum of a padded array of float32."""
    total = np.float32(0.0)
    for at in range(numbers.shape[0] // _BLOCK * _BLOCK):
        total += numbers[at]
    return float(total)


@kernel(fastmath=_FAST)
def _product(one, other):
    """Return the scalar product of two padded arrays of float32."""
    total = np.float32(0.0)
    for at in range(one.shape[0] // _BLOCK * _BLOCK):
        total += one[at] * other[at]
    return float(total)


@kernel(fastmath=_FAST)
def _sums_with_offsets(numbers, work):
    """Return the sum of a padded array, and the sums of its numbers times the offsets x and y."""
    total, with_x, with_y = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for at in range(numbers.shape[0] // _BLOCK * _BLOCK):
        number = numbers[at]
        total += number
        with_x += number * work.offset_x[at]
        with_y += number * work.offset_y[at]
    return float(total), float(with_x), float(with_y)


@kernel(fastmath=_FAST)
def _products_with_offsets(one, other, work):
    """Return the same of the products of two arrays."""
    total, with_x, with_y = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for at in range(one.shape[0] // _BLOCK * _BLOCK):
        number = one[at] * other[at]
        total += number
        with_x += number * work.offset_x[at]
        with_y += number * work.offset_y[at]
    return float(total), float(with_x), float(with_y)


@kernel(fastmath=_FAST)
def _products_with_squares(one, other, work):
    """Return the sums of the products of two arrays times 1, x, y, x x, x y and y y."""
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
    _place(to_search, height, width, work)
    for at in range(0, size, LANES):
        interpolate_pixels(flat, width, work.first, work.right, work.below, at, found)
    return _centre(found, size)


@kernel
def _place(to_search, height, width, work):
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
def _iterate(
    search, x, y, to_search, line, constrained, options, work, patch, mean, energy, factor, found, quality,
):  # fmt: skip
    """Do Gauss-Newton steps until they are small; write the map and its quality, return the outcome."""
    steps, precision, reach, stretch = int(options[0]), options[1], options[2], options[3]
    half, count = work.half, patch.shares.shape[0]
    size, spread = (2 * half + 1) ** 2, half * (half + 1) / 3.0
    projected, step = np.empty(count), np.empty(count)
    start_x, start_y = to_search[0], to_search[1]
    if not constrained and not _factorise(patch.normal, factor):
        return TEXTURELESS
    for taken in range(steps):
        outcome = _misplaced(search, to_search, half, reach, stretch, start_x, start_y)
        if outcome != CONVERGED:
            return outcome
        found_mean = take_search(search, to_search, work, found)
        along, power = compare(patch, work, found, projected)
        if not math.isfinite(power):
            return MISSING
        if power <= 1e-9 * size:
            return UNLIKE
        if constrained and not _factorise_on_line(patch.normal, to_search, line, factor):
            return TEXTURELESS
        _solve(factor, projected, step)
        gain, unexplained = along / energy, power - along * along / energy
        for k in range(count):
            gain -= patch.shares[k] * step[k]
            unexplained -= projected[k] * step[k]
        correlation = along / math.sqrt(energy * power)
        quality[3], quality[7] = correlation, taken + 1
        scale = gain if correlation > 0.5 and gain > 0 else math.sqrt(power / energy)
        moved = _move(to_search, step, scale, spread)
        if constrained:
            _put_on_line(to_search, line, start_x, start_y)
        if moved < precision:
            if correlation <= 0:
                return UNLIKE
            outcome = _misplaced(search, to_search, half, reach, stretch, start_x, start_y)
            if outcome != CONVERGED:
                return outcome
            quality[4], quality[5] = scale, found_mean - scale * mean
            residual2 = max(unexplained, 0.0) / (size - count - 2 + constrained)
            known = _allow_for_noise(
                x, y, to_search, line, constrained, residual2, options[5], scale, work, patch, factor, quality,
            )  # fmt: skip
            if constrained:
                _put_on_line(to_search, line, start_x, start_y)
            return CONVERGED if known else TEXTURELESS
    return UNFINISHED


@kernel
def _misplaced(search, to_search, half, reach, stretch, start_x, start_y):
    """Return why a map cannot be used, or CONVERGED if it can."""
    u, v, a, b, c, d = to_search
    if not (math.hypot(u - start_x, v - start_y) <= reach):
        return STRAYED
    square, area = a * a + b * b + c * c + d * d, a * d - b * c
    root = math.sqrt(max(square * square - 4 * area * area, 0.0))
    longest, shortest = math.sqrt(0.5 * (square + root)), math.sqrt(max(0.5 * (square - root), 0.0))
    if not (area > 0 and longest <= stretch and shortest * stretch >= 1):
        return DEGENERATE
    wide, high = half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
    return CONVERGED if _within(search, u, v, wide, high) else LEFT_PICTURE


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


@kernel
def _factorise(normal, factor):
    """Write the Cholesky factor of a normal matrix; return false if it has none."""
    count = normal.shape[0]
    for k in range(count):
        for m in range(k + 1):
            total = normal[k, m]
            for j in range(m):
                total -= factor[k, j] * factor[m, j]
            if k > m:
                factor[k, m] = total / factor[m, m]
            elif total > 1e-10 * normal[k, k]:
                factor[k, k] = math.sqrt(total)
            else:
                return False
    return True


@kernel
def _factorise_on_line(normal, to_search, line, factor):
    """Do so for steps that keep the centre on its line in the search image."""
    x = line[0] * to_search[4] - line[1] * to_search[2]
    y = line[0] * to_search[5] - line[1] * to_search[3]
    stiff = _STIFF * (normal[0, 0] + normal[1, 1]) / (x * x + y * y)
    held = normal.copy()
    held[0, 0] += stiff * x * x
    held[1, 0] += stiff * x * y
    held[1, 1] += stiff * y * y
    return _factorise(held, factor)


@kernel
def _solve(factor, right, out):
    count = right.shape[0]
    for k in range(count):
        total = right[k]
        for j in range(k):
            total -= factor[k, j] * out[j]
        out[k] = total / factor[k, k]
    for k in range(count - 1, -1, -1):
        total = out[k]
        for j in range(k + 1, count):
            total -= factor[j, k] * out[j]
        out[k] = total / factor[k, k]


@kernel
def _move(to_search, step, scale, spread):
    """Apply the inverse of the template's displacement to the map; return its rms over the patch's pixels [px]."""
    x, y = step[0] / scale, step[1] / scale
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    if step.shape[0] == 6:
        a, b, c, d = step[2] / scale, step[3] / scale, step[4] / scale, step[5] / scale
    moved = math.sqrt(x * x + y * y + spread * (a * a + b * b + c * c + d * d))
    if moved > _BOUNDED:
        share = _BOUNDED / moved
        x, y, a, b, c, d = share * x, share * y, share * a, share * b, share * c, share * d
    area = (1 + a) * (1 + d) - b * c
    ia, ib, ic, id_ = (1 + d) / area, -b / area, -c / area, (1 + a) / area
    u, v, p, q, r, s = to_search
    to_search[2], to_search[3] = p * ia + q * ic, p * ib + q * id_
    to_search[4], to_search[5] = r * ia + s * ic, r * ib + s * id_
    to_search[0] = u - to_search[2] * x - to_search[3] * y
    to_search[1] = v - to_search[4] * x - to_search[5] * y
    return moved


@kernel
def _put_on_line(to_search, line, x, y):
    along = (to_search[0] - x) * line[0] + (to_search[1] - y) * line[1]
    to_search[0], to_search[1] = x + along * line[0], y + along * line[1]


@kernel(fastmath=_FAST)
def _kept_noise(to_search, work):
    """Return the share of an image's noise variance in values between its pixels, mean over a patch."""
    size, total = (2 * work.half + 1) ** 2, np.float32(0.0)
    _place(to_search, 0, 0, work)
    for at in range(size):
        total += kept_in_values(work.right[at]) * kept_in_values(work.below[at])
    return total / np.float32(size)


@kernel(fastmath=_FAST)
def kept_in_values(t):
    """Return the share of a pixel's noise variance in a spline's values, along one axis.

    Each value is the sum of all pixels with weights that are cubic polynomials of the place `t` between two pixels. The
    sum of their squares is a polynomial that does not change if `t` and 1 - t are exchanged.
    """
    s = t * (np.float32(1.0) - t)
    return np.float32(1.0) - s * s * (np.float32(3.0) + np.float32(14 - 6 * math.sqrt(3)) * s)


@kernel
def kept_in_slopes(t):
    """Return the share in its slopes [1/px2]."""
    s = t * (1 - t)
    return 6 * math.sqrt(3) - 9 + (126 - 54 * math.sqrt(3)) * s * s


@kernel
def kept_in_both(t):
    """Return the covariance of both, half the derivative of the share in the values [1/px]."""
    s = t * (1 - t)
    return (2 * t - 1) * s * (3 + (21 - 9 * math.sqrt(3)) * s)


@kernel
def _allow_for_noise(
    x, y, to_search, line, constrained, residual2, stated2, gain, work, patch, factor, quality,
):  # fmt: skip
    """Correct the map for the noise's bias and write covariance and noise; return false if the template is only noise.

    The tests compare it with `noise_effects` in tests/reference_matching.py.
    """
    normal, count, size = patch.normal, patch.normal.shape[0], (2 * work.half + 1) ** 2
    right, below = x - math.floor(x), y - math.floor(y)
    across, down = kept_in_values(right), kept_in_values(below)
    noise2 = residual2 / (gain * gain * across * down + _kept_noise(to_search, work))
    white2 = min(noise2, stated2)
    true, unit, spread = normal.copy(), np.zeros((3, count)), work.half * (work.half + 1) / 3.0
    for k in range(count):
        slope = kept_in_slopes(right) * down if k in (0, 2, 3) else kept_in_slopes(below) * across
        true[k, k] -= white2 * slope * size * (spread if k > 1 else 1.0)
        unit[2, k] = -white2 * size * patch.shares[k] * across * down
    if not (_factorise_on_line(true, to_search, line, factor) if constrained else _factorise(true, factor)):
        return False
    unit[0, 0] = unit[1, 1] = 1.0
    unit[2, 0] += white2 * size * kept_in_both(right) * down
    unit[2, 1] += white2 * size * kept_in_both(below) * across
    column, variances = np.empty(count), np.empty((2, 2))
    _solve(factor, unit[2], column)
    _move(to_search, column, 1.0, spread)
    for k in range(2):
        _solve(factor, unit[k], column)
        across, down = noise2 * column[0], noise2 * column[1]
        for i in range(count):
            total = 0.0
            for j in range(count):
                total += normal[i, j] * column[j]
            unit[k, i] = total
        _solve(factor, unit[k], column)
        variances[k, 0] = across + noise2 / (gain * gain) * column[0]
        variances[k, 1] = down + noise2 / (gain * gain) * column[1]
    a, b, c, d = to_search[2], to_search[3], to_search[4], to_search[5]
    p, q, r, s = variances[0, 0], variances[0, 1], variances[1, 0], variances[1, 1]
    xx, yy = a * (p * a + q * b) + b * (r * a + s * b), c * (p * c + q * d) + d * (r * c + s * d)
    xy, yx = a * (p * c + q * d) + b * (r * c + s * d), c * (p * a + q * b) + d * (r * a + s * b)
    if constrained:
        along = line[0] * (xx * line[0] + xy * line[1]) + line[1] * (yx * line[0] + yy * line[1])
        xx, yy, xy = along * line[0] * line[0], along * line[1] * line[1], along * line[0] * line[1]
    quality[0], quality[1], quality[2] = xx, yy, xy
    quality[6] = math.sqrt(noise2)
    return True
