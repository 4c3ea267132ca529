"""Compiled kernels of `marey.images.matching.matching`, which process one patch after the other."""

import math

import numpy as np

from marey.compiled.kernels import kernel
from marey.images.matching.patch_kernels import (
    FAST,
    compare,
    padded_size,
    patch_work,
    place_patch,
    take_search,
    take_template,
    template_patch,
)

CONVERGED, LEFT_PICTURE, TEXTURELESS, DEGENERATE, STRAYED, UNLIKE, UNFINISHED, MISSING = range(8)
"""Outcome of the matching of a patch, described by `marey.images.matching.matching.Outcome`."""

_BOUNDED = 2.0
"""Largest displacement of the patch in one step, root mean square over its pixels [px]. Chosen by hand."""
_STIFF = 1e6
"""Weight of the constraint of a step to its line, relative to the information of the grey values. Chosen by hand."""


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


@kernel(fastmath=FAST)
def _kept_noise(to_search, work):
    """Return the share of an image's noise variance in values between its pixels, mean over a patch."""
    size, total = (2 * work.half + 1) ** 2, np.float32(0.0)
    place_patch(to_search, 0, 0, work)
    for at in range(size):
        total += kept_in_values(work.right[at]) * kept_in_values(work.below[at])
    return total / np.float32(size)


@kernel(fastmath=FAST)
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
