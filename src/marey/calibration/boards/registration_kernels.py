"""Registration of the surroundings of many corners to a picture: compiled loops."""

import numpy as np

from marey.compiled.kernels import kernel

CORRELATION, COUNT, SHIFT_X, SHIFT_Y, VAR_X, VAR_XY, VAR_Y = range(7)
"""Columns of the result of `register_corners`: correlation, pixels, shift [px], covariance for unit noise variance."""
_MOST_STEPS = 8
"""Largest number of Gauss-Newton steps of a corner; chosen by hand."""
_LEAST_PIXELS = 16
"""Smallest number of pixels around a corner; chosen by hand."""
_CONVERGED_PX2 = 1e-5
"""Square of the step that ends the registration [px2]; chosen by hand."""


@kernel
def cubic_weights(t, out):
    """Write the four weights of Catmull and Rom's cubic for a position t from 0 to 1 between the middle samples."""
    out[0] = t * (-0.5 + t * (1.0 - 0.5 * t))
    out[1] = 1.0 + t * t * (-2.5 + 1.5 * t)
    out[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    out[3] = t * t * (-0.5 + 0.5 * t)


@kernel
def moved_patch(grey, x0, y0, dx, dy, out):
    """Write the part (h, w) of a picture that begins at x0 + dx, y0 + dy, by cubic interpolation [grey levels]."""
    height, width = grey.shape
    wx, wy = np.empty(4), np.empty(4)
    ix, iy = int(np.floor(dx)), int(np.floor(dy))
    cubic_weights(dx - ix, wx)
    cubic_weights(dy - iy, wy)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for a in range(4):
                row = min(max(y0 + i + iy + a - 1, 0), height - 1)
                line = 0.0
                for b in range(4):
                    column = min(max(x0 + j + ix + b - 1, 0), width - 1)
                    line += wx[b] * grey[row, column]
                total += wy[a] * line
            out[i, j] = total


@kernel
def slopes_of(image, along_x, along_y):
    """Write the central differences of an image (h, w) along x and y, one-sided at its edges, as `numpy.gradient`."""
    height, width = image.shape
    for i in range(height):
        above, below = max(i - 1, 0), min(i + 1, height - 1)
        for j in range(width):
            left, right = max(j - 1, 0), min(j + 1, width - 1)
            along_x[i, j] = (image[i, right] - image[i, left]) / (right - left)
            along_y[i, j] = (image[below, j] - image[above, j]) / (below - above)


@kernel
def blur_equations(model, part, inner, normal, right):
    """Add up the normal equations of level, shift and blur that make a model fit a part of a picture.

    To first order the picture is a sum of the model, a constant, the model's slopes (shift) and its second derivatives
    (blur).

    Args:
        model: (h, w) the blurred print, at least 2 x 2.
        part: (h, w) the picture.
        inner: (h, w) true where pixels count.
        normal: (7, 7) is filled: gain, level, shift along x and y [px], variances xx, xy and yy of the blur [px2].
        right: (7,) is filled.
    """
    height, width = model.shape
    along_x, along_y = np.empty((height, width)), np.empty((height, width))
    slopes_of(model, along_x, along_y)
    normal[:], right[:] = 0.0, 0.0
    row = np.empty(7)
    for i in range(height):
        above, below = max(i - 1, 0), min(i + 1, height - 1)
        for j in range(width):
            if not inner[i, j]:
                continue
            before, behind = max(j - 1, 0), min(j + 1, width - 1)
            across, down = 1.0 / (behind - before), 1.0 / (below - above)
            row[0], row[1] = model[i, j], 1.0
            row[2], row[3] = -along_x[i, j], -along_y[i, j]
            row[4] = 0.5 * (along_x[i, behind] - along_x[i, before]) * across
            row[5] = (along_y[i, behind] - along_y[i, before]) * across
            row[6] = 0.5 * (along_y[below, j] - along_y[above, j]) * down
            for a in range(7):
                right[a] += row[a] * part[i, j]
                for b in range(a + 1):
                    normal[a, b] += row[a] * row[b]
    for a in range(7):
        for b in range(a):
            normal[b, a] = normal[a, b]


@kernel
def _brightness(patch, printed, near):
    """Return pixels, gain, level and correlation of a picture (h, w) and the print; gain 0 if they disagree."""
    count, st, sp, stt, stp, spp = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            if near[i, j]:
                t, p = printed[i, j], patch[i, j]
                count += 1
                st, sp = st + t, sp + p
                stt, stp, spp = stt + t * t, stp + t * p, spp + p * p
    if count < _LEAST_PIXELS:
        return count, 0.0, 0.0, 0.0
    vt, vp, cross = stt - st * st / count, spp - sp * sp / count, stp - st * sp / count
    if not (vt > 0.0 and vp > 0.0 and cross > vt):
        return count, 0.0, 0.0, 0.0
    gain = cross / vt
    return count, gain, (sp - gain * st) / count, cross / np.sqrt(vt * vp)


@kernel
def _shift_equations(patch, printed, slope_x, slope_y, near, gain, level, normal, right):
    """Fill the normal equations (4, 4) and (4,) of shift along x and y, gain and level; return the sum of squares."""
    normal[:], right[:] = 0.0, 0.0
    slope, square = np.empty(4), 0.0
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            if near[i, j]:
                t = printed[i, j]
                slope[0], slope[1] = -gain * slope_x[i, j], -gain * slope_y[i, j]
                slope[2], slope[3] = t, 1.0
                e = patch[i, j] - gain * t - level
                square += e * e
                for a in range(4):
                    right[a] += slope[a] * e
                    for b in range(4):
                        normal[a, b] += slope[a] * slope[b]
    return square


@kernel
def _of_shift_alone(normal, right):
    """Eliminate gain and level from the equations of `_shift_equations`.

    Returns:
        Elements xx, xy and yy of the (2, 2) system of the shift, and its right side; zeros if it is singular.
    """
    d = normal[2, 2] * normal[3, 3] - normal[2, 3] ** 2
    if not d > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    i22, i23, i33 = normal[3, 3] / d, -normal[2, 3] / d, normal[2, 2] / d
    e0, e1 = i22 * right[2] + i23 * right[3], i23 * right[2] + i33 * right[3]
    gx, gy = right[0] - normal[0, 2] * e0 - normal[0, 3] * e1, right[1] - normal[1, 2] * e0 - normal[1, 3] * e1
    ux, uy = i22 * normal[0, 2] + i23 * normal[0, 3], i23 * normal[0, 2] + i33 * normal[0, 3]
    vx, vy = i22 * normal[1, 2] + i23 * normal[1, 3], i23 * normal[1, 2] + i33 * normal[1, 3]
    xx = normal[0, 0] - normal[0, 2] * ux - normal[0, 3] * uy
    xy = normal[0, 1] - normal[0, 2] * vx - normal[0, 3] * vy
    yy = normal[1, 1] - normal[1, 2] * vx - normal[1, 3] * vy
    return xx, xy, yy, gx, gy


@kernel
def register_corners(grey, model, slope_x, slope_y, place, on_board, first, windows, centres, reach, shift, most, out):
    """Register the surroundings of corners, see `marey.calibration.boards.registration`.

    Args:
        grey: (H, W) uint8 the picture.
        model: (h, w) the blurred print.
        slope_x: (h, w) its slope along x [1/px].
        slope_y: (h, w) its slope along y [1/px].
        place: (h, w, 2) position of each pixel on the board [m].
        on_board: (h, w) true on the print.
        first: (2,) x, y of the model's first pixel in the picture.
        windows: (n, 4) first column, first row, and those behind the last, in the model.
        centres: (n, 2) the corners on the board [m].
        reach: half width of the surroundings on the board [m].
        shift: (2,) start of the shift from the model to the picture [px].
        most: largest shift of a corner from the start [px].
        out: (n, 7) is filled, NaN where a corner was not found; the covariance still lacks the noise variance, which
            is given as the residuals' mean square in the column behind it.
    """
    normal, right = np.empty((4, 4)), np.empty(4)
    for k in range(len(windows)):
        out[k] = np.nan
        left, top, behind, below = windows[k, 0], windows[k, 1], windows[k, 2], windows[k, 3]
        if behind - left < 3 or below - top < 3:
            continue
        away = np.abs(place[top:below, left:behind] - centres[k])
        near = on_board[top:below, left:behind] & (away[:, :, 0] < reach) & (away[:, :, 1] < reach)
        printed = model[top:below, left:behind]
        across, down = slope_x[top:below, left:behind], slope_y[top:below, left:behind]
        patch = np.empty(printed.shape)
        x, y = shift[0], shift[1]
        for step in range(_MOST_STEPS):
            moved_patch(grey, first[0] + left, first[1] + top, x, y, patch)
            count, gain, level, correlation = _brightness(patch, printed, near)
            if not gain > 0.0:
                break
            square = _shift_equations(patch, printed, across, down, near, gain, level, normal, right)
            xx, xy, yy, gx, gy = _of_shift_alone(normal, right)
            d = xx * yy - xy * xy
            if not d > 1e-12:
                break
            dx, dy = (yy * gx - xy * gy) / d, (xx * gy - xy * gx) / d
            x, y = x + dx, y + dy
            if (x - shift[0]) ** 2 + (y - shift[1]) ** 2 > most * most:
                break
            if dx * dx + dy * dy < _CONVERGED_PX2 or step == _MOST_STEPS - 1:
                noise = square / max(count - 4, 1)
                out[k, 0], out[k, 1] = correlation, count
                out[k, 2], out[k, 3] = x, y
                out[k, 4], out[k, 5], out[k, 6] = noise * yy / d, -noise * xy / d, noise * xx / d
                break
