"""Compiled kernels of `marey.images.matching.matching`, which process one patch after the other."""

import math

import numpy as np

from marey.compiled.kernels import kernel
from marey.images.matching.splines import noise_shares
from marey.lanes import weighted_square

CONVERGED, LEFT_PICTURE, TEXTURELESS, DEGENERATE, STRAYED, UNLIKE, UNFINISHED, MISSING = range(8)
"""Outcome of the matching of a patch, described by `marey.images.matching.matching.Outcome`."""

_BOUNDED = 2.0
"""Largest displacement of the patch in one step, root mean square over its pixels [px]. Chosen by hand."""
KEPT, KEPT_SLOPE, KEPT_BOTH = noise_shares(1025)
"""Share of a pixel's noise variance in a spline's values, slopes, and their covariance, by fraction of a pixel."""
_STIFF = 1e6
"""Weight of the constraint of a step to its line, relative to the information of the grey values. Chosen by hand."""
_FAST = {"reassoc", "contract", "arcp", "nsz"}
"""Sums in any order; NaN stays NaN, for it marks missing pixels."""


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
    size = (2 * half + 1) ** 2
    columns, grey, found = np.empty((count, size)), np.empty(size), np.empty(size)
    shares, normal, factor = np.empty(count), np.empty((count, count)), np.empty((count, count))
    pixel_work = search_work(half)
    for i in range(pixels.shape[0]):
        quality[i] = np.nan
        quality[i, 7] = 0
        x, y = pixels[i]
        if not (_finite(maps[i]) and math.isfinite(x + y) and (not constrained or _finite(lines[i]))):
            outcomes[i] = MISSING
        elif not _within(template, x, y, half, half):
            outcomes[i] = LEFT_PICTURE
        else:
            mean, energy = take_template(template, x, y, half, columns, grey, shares, normal)
            outcomes[i] = _unusable(normal, size, maps[i], lines[i], constrained, options[4], energy)
            if outcomes[i] == CONVERGED:
                outcomes[i] = _iterate(
                    search, x, y, maps[i], lines[i], constrained, half, options,
                    columns, grey, mean, energy, shares, normal, factor, found, pixel_work, quality[i],
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


@kernel(fastmath=_FAST)
def take_template(picture, x, y, half, columns, grey, shares, normal):
    """Take a patch of the template and what it needs to be compared, once for all steps.

    Args:
        picture: (H, W) coefficients.
        x: of the centre [px].
        y: of the centre [px].
        half: pixels from the centre to the edge.
        columns: (2 or 6, N) for the grey values' derivatives by the affine map (shift x, shift y, and the linear part
            row by row), less what gain and offset explain of them.
        grey: (N,) for the grey values less their mean.
        shares: (2 or 6,) for how much of the grey values each derivative held.
        normal: (2 or 6, 2 or 6) for the columns' normal matrix.

    Returns:
        The mean grey value, and the sum of squares about it.
    """
    size, count = grey.shape[0], columns.shape[0]
    mean = _take_values(picture, x, y, half, columns, grey)
    energy = 0.0
    for i in range(size):
        grey[i] -= mean
        energy += grey[i] * grey[i]
    side = 2 * half + 1
    if count == 6:
        for i in range(side):
            for j in range(side):
                at = i * side + j
                columns[2, at], columns[3, at] = columns[0, at] * (j - half), columns[0, at] * (i - half)
                columns[4, at], columns[5, at] = columns[1, at] * (j - half), columns[1, at] * (i - half)
    for k in range(count):
        total, held = 0.0, 0.0
        for i in range(size):
            total += columns[k, i]
            held += columns[k, i] * grey[i]
        total, held = total / size, held / max(energy, 1e-300)
        for i in range(size):
            columns[k, i] -= total + held * grey[i]
        shares[k] = held
    for k in range(count):
        for m in range(k + 1):
            total = 0.0
            for i in range(size):
                total += columns[k, i] * columns[m, i]
            normal[k, m] = normal[m, k] = total
    return mean, energy


@kernel(fastmath=_FAST)
def _take_values(picture, x, y, half, columns, grey):
    """Write values and gradients of a patch aligned with the pixel axes; return the mean value."""
    side = 2 * half + 1
    column, row = math.floor(x), math.floor(y)
    x_taps, x_slopes = _cubic(np.float32(x - column)), _cubic_slopes(np.float32(x - column))
    y_taps, y_slopes = _cubic(np.float32(y - row)), _cubic_slopes(np.float32(y - row))
    value, slope = np.empty(side + 3, np.float32), np.empty(side + 3, np.float32)
    left, top, total = int(column) - half - 1, int(row) - half - 1, 0.0
    for i in range(side):
        # Slices begin at index 0, so that the compiler vectorises the loops.
        a, b = picture[top + i, left : left + side + 3], picture[top + i + 1, left : left + side + 3]
        c, d = picture[top + i + 2, left : left + side + 3], picture[top + i + 3, left : left + side + 3]
        for j in range(side + 3):
            value[j] = y_taps[0] * a[j] + y_taps[1] * b[j] + y_taps[2] * c[j] + y_taps[3] * d[j]
            slope[j] = y_slopes[0] * a[j] + y_slopes[1] * b[j] + y_slopes[2] * c[j] + y_slopes[3] * d[j]
        row_grey = grey[i * side : (i + 1) * side]
        row_x, row_y = columns[0, i * side : (i + 1) * side], columns[1, i * side : (i + 1) * side]
        for j in range(side):
            p, q, r, s = value[j], value[j + 1], value[j + 2], value[j + 3]
            row_grey[j] = x_taps[0] * p + x_taps[1] * q + x_taps[2] * r + x_taps[3] * s
            row_x[j] = x_slopes[0] * p + x_slopes[1] * q + x_slopes[2] * r + x_slopes[3] * s
            row_y[j] = (
                x_taps[0] * slope[j] + x_taps[1] * slope[j + 1] + x_taps[2] * slope[j + 2] + x_taps[3] * slope[j + 3]
            )
            total += row_grey[j]
    return total / (side * side)


@kernel
def search_work(half):
    """Return work arrays of `take_search` for patches of one size.

    Returns:
        Offsets x, y (2, N) of the pixels from the centre, and space for weights (8, N) and indices (N,).
    """
    side = 2 * half + 1
    offsets = np.empty((2, side * side))
    for i in range(side):
        for j in range(side):
            offsets[0, i * side + j], offsets[1, i * side + j] = j - half, i - half
    return offsets, np.empty((8, side * side), np.float32), np.empty(side * side, np.int32)


@kernel(fastmath=_FAST)
def take_search(picture, to_search, pixel_work, found):
    """Write the search image's values at the mapped pixels of the patch; return their mean.

    The weights of all pixels are computed first, in a loop that the compiler vectorises.

    Args:
        picture: (H, W) coefficients.
        to_search: (6,) the map: place of the centre [px], and the linear part row by row.
        pixel_work: result of `search_work`.
        found: (N,) for the values.
    """
    height, width = picture.shape
    flat, offsets, weights, first = picture.reshape(height * width), pixel_work[0], pixel_work[1], pixel_work[2]
    u, v, a, b, c, d = to_search
    total = 0.0
    p0, p1, p2, p3, q0, q1, q2, q3 = (
        weights[0], weights[1], weights[2], weights[3], weights[4], weights[5], weights[6], weights[7],
    )  # fmt: skip
    for at in range(found.shape[0]):
        x = u + a * offsets[0, at] + b * offsets[1, at]
        y = v + c * offsets[0, at] + d * offsets[1, at]
        column, row = np.int32(x), np.int32(y)
        p0[at], p1[at], p2[at], p3[at] = _cubic(np.float32(x - column))
        q0[at], q1[at], q2[at], q3[at] = _cubic(np.float32(y - row))
        first[at] = (row - 1) * width + column - 1
    for at in range(found.shape[0]):
        found[at] = weighted_square(
            flat, first[at], width, (p0[at], p1[at], p2[at], p3[at]), (q0[at], q1[at], q2[at], q3[at])
        )
        total += found[at]
    return total / found.shape[0]


@kernel
def _iterate(
    search, x, y, to_search, line, constrained, half, options,
    columns, grey, mean, energy, shares, normal, factor, found, pixel_work, quality,
):  # fmt: skip
    """Do Gauss-Newton steps until they are small; write the map and its quality, return the outcome."""
    steps, precision, reach, stretch = int(options[0]), options[1], options[2], options[3]
    size, count = grey.shape[0], columns.shape[0]
    projected, step = np.empty(count), np.empty(count)
    start_x, start_y = to_search[0], to_search[1]
    spread = half * (half + 1) / 3.0
    if not constrained and not _factorise(normal, factor):
        return TEXTURELESS
    for taken in range(steps):
        outcome = _misplaced(search, to_search, half, reach, stretch, start_x, start_y)
        if outcome != CONVERGED:
            return outcome
        found_mean = take_search(search, to_search, pixel_work, found)
        along, power = compare(columns, grey, found, found_mean, projected)
        if not math.isfinite(power):
            return MISSING
        if power <= 1e-9 * size:
            return UNLIKE
        if constrained and not _factorise_on_line(normal, to_search, line, factor):
            return TEXTURELESS
        _solve(factor, projected, step)
        gain, unexplained = along / energy, power - along * along / energy
        for k in range(count):
            gain -= shares[k] * step[k]
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
                normal, shares, factor, x, y, half, to_search, line, constrained, residual2, options[5], scale,
                pixel_work[0], quality,
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


@kernel(fastmath=_FAST)
def compare(columns, grey, found, mean, projected):
    """Project the found values on the template's derivatives; return their product with the template and energy."""
    along, power = 0.0, 0.0
    for i in range(found.shape[0]):
        found[i] -= mean
        along += found[i] * grey[i]
        power += found[i] * found[i]
    for k in range(columns.shape[0]):
        total, column = 0.0, columns[k]
        for i in range(found.shape[0]):
            total += found[i] * column[i]
        projected[k] = total
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
def _kept_noise(to_search, offsets):
    """Return the share of an image's noise variance in values between its pixels, mean over a patch."""
    u, v, a, b, c, d = to_search
    total = 0.0
    for at in range(offsets.shape[1]):
        x = u + a * offsets[0, at] + b * offsets[1, at]
        y = v + c * offsets[0, at] + d * offsets[1, at]
        total += _looked_up(KEPT, x) * _looked_up(KEPT, y)
    return total / offsets.shape[1]


@kernel
def _looked_up(table, x):
    return table[int((x - math.floor(x)) * (table.shape[0] - 1) + 0.5)]


@kernel
def _allow_for_noise(
    normal, shares, factor, x, y, half, to_search, line, constrained, residual2, stated2, gain,
    offsets, quality,
):  # fmt: skip
    """Correct the map for the noise's bias and write covariance and noise; return false if the template is only noise.

    The tests compare it with `noise_effects` in tests/reference_matching.py.
    """
    count, size = normal.shape[0], (2 * half + 1) ** 2
    across, down = _looked_up(KEPT, x), _looked_up(KEPT, y)
    noise2 = residual2 / (gain * gain * across * down + _kept_noise(to_search, offsets))
    white2 = min(noise2, stated2)
    true, unit, spread = normal.copy(), np.zeros((3, count)), half * (half + 1) / 3.0
    for k in range(count):
        slope = _looked_up(KEPT_SLOPE, x) * down if k in (0, 2, 3) else _looked_up(KEPT_SLOPE, y) * across
        true[k, k] -= white2 * slope * size * (spread if k > 1 else 1.0)
        unit[2, k] = -white2 * size * shares[k] * across * down
    if not (_factorise_on_line(true, to_search, line, factor) if constrained else _factorise(true, factor)):
        return False
    unit[0, 0] = unit[1, 1] = 1.0
    unit[2, 0] += white2 * size * _looked_up(KEPT_BOTH, x) * down
    unit[2, 1] += white2 * size * _looked_up(KEPT_BOTH, y) * across
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
