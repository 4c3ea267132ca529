"""Matching of small patches whose pixels were carried from their first image to the present one by a moving surface.

The surface predicts where each pixel of the patch should be, so that its deformation is known; only a shift of the
entire patch, and gain and offset of its grey values, are estimated ([Baker2004], the forwards additive algorithm).
"""

import math
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Mask
from marey.compiled.kernels import kernel

STEPS = 8
"""Largest number of Gauss-Newton steps of a patch's shift. Chosen by hand."""
STOP_PX = 0.02
"""Length of a step that ends the iteration [px]. Chosen by hand."""
FAR_COST = 0.004
"""Correlation that a shift must gain per squared pixel of distance from the prediction, in the search by whole pixels
[1/px2]. Chosen by hand."""
PRIOR_PX = 3.0
"""Standard deviation of the shift about its start, where a patch without texture in one direction is kept [px]. It does
not enter the information that is returned. Chosen by hand."""
NOISE_IN_GRADIENTS = 0.2
"""Variance of the gradients that is noise, as a share of the variance of the difference of two images. Half of that
difference is the noise of the image, whose central differences over two pixels have half its variance, less the
correlation of smoothed pixels."""
DISTINCT_PIXELS = 0.25
"""Share of the pixels that count as independent: smoothing and compression correlate neighbours. Chosen by hand."""


class PatchMatches(NamedTuple):
    """Shifts of patches, with their information."""

    shift: Floats
    """(n, 2) from the predicted to the measured position [px]; NaN where no shift was found."""
    information: Floats
    """(n, 2, 2) inverse covariance of the shift [1/px2]."""
    noise: Floats
    """(n,) variance of the difference of the grey values, after gain and offset [grey2]."""
    contrast: Floats
    """(n,) variance of the patch's grey values, as the image shows them, over the pixels used [grey2]."""


def match_patches(
    image: Floats, pixels: Floats, used: Mask, grey: Floats, start: Floats, *, search: int, least_pixels: int,
    least_noise: float,
) -> PatchMatches:  # fmt: skip
    """Find the shift of each patch in an image.

    Args:
        image: (H, W) grey values, smoothed like the first image of the patches.
        pixels: (n, k, 2) predicted positions of the patches' pixels [px].
        used: (n, k) false for pixels that are hidden or were no part of the patch.
        grey: (n, k) grey values of the patches in their first image.
        start: (n, 2) shift at which the search starts [px].
        search: Largest distance from the start that is searched by whole pixels [px].
        least_pixels: Smallest number of pixels of a patch.
        least_noise: Least variance of a difference of grey values [grey2].
    """
    count = len(pixels)
    found = PatchMatches(
        np.full((count, 2), np.nan), np.zeros((count, 2, 2)), np.full(count, np.nan), np.full(count, np.nan)
    )  # fmt: skip
    write_matches(
        np.ascontiguousarray(image, np.float32), pixels, used, grey, start, search, least_pixels, least_noise, *found
    )
    return found


@kernel
def bilinear(image, x, y):
    """Return the value of an image between its pixels; NaN outside."""
    height, width = image.shape
    # A comparison with NaN is false.
    if not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
        return np.nan
    i, j = int(x), int(y)
    u, v = x - i, y - j
    return (1 - v) * ((1 - u) * image[j, i] + u * image[j, i + 1]) + v * (
        (1 - u) * image[j + 1, i] + u * image[j + 1, i + 1]
    )


@kernel
def take_grey(image, pixels, used, dx, dy, out):
    """Sample an image at shifted pixels (k, 2) into out (k,); return how many of those used lie inside the image."""
    count = 0
    for i in range(len(pixels)):
        out[i] = np.nan
        if used[i]:
            out[i] = bilinear(image, pixels[i, 0] + dx, pixels[i, 1] + dy)
            if out[i] == out[i]:
                count += 1
    return count


@kernel
def fit_gain(grey, found):
    """Fit found = gain grey + offset; return gain, offset, and the sums of squares of grey, found and their product."""
    count, a, b = 0, 0.0, 0.0
    for i in range(len(grey)):
        if found[i] == found[i]:
            count += 1
            a += grey[i]
            b += found[i]
    a, b = a / count, b / count
    aa, bb, ab = 0.0, 0.0, 0.0
    for i in range(len(grey)):
        if found[i] == found[i]:
            aa += (grey[i] - a) ** 2
            bb += (found[i] - b) ** 2
            ab += (grey[i] - a) * (found[i] - b)
    gain = ab / aa if aa > 0 else 0.0
    return gain, b - gain * a, aa, bb, ab


@kernel
def search_whole_pixels(image, pixels, used, grey, x, y, reach, least_pixels, found):
    """Find the best shift on a grid of whole pixels about a start, by correlation less the cost of the distance.

    Returns:
        Whether any shift has enough pixels in the image; and the shift.
    """
    best, best_x, best_y = -np.inf, x, y
    for j in range(-reach, reach + 1):
        for i in range(-reach, reach + 1):
            if i * i + j * j > reach * reach:
                continue
            if take_grey(image, pixels, used, x + i, y + j, found) < least_pixels:
                continue
            _, _, aa, bb, ab = fit_gain(grey, found)
            if aa <= 0 or bb <= 0:
                continue
            score = ab / math.sqrt(aa * bb) - FAR_COST * (i * i + j * j)
            if score > best:
                best, best_x, best_y = score, x + i, y + j
    return best > -np.inf, best_x, best_y


@kernel
def take_gradients(image, pixels, x, y, found, across, down):
    """Write the image's gradients at shifted pixels; where they are unknown, found becomes NaN, too."""
    for i in range(len(pixels)):
        across[i] = down[i] = 0.0
        if found[i] == found[i]:
            u, v = pixels[i, 0] + x, pixels[i, 1] + y
            across[i] = 0.5 * (bilinear(image, u + 1, v) - bilinear(image, u - 1, v))
            down[i] = 0.5 * (bilinear(image, u, v + 1) - bilinear(image, u, v - 1))
            if not (across[i] == across[i] and down[i] == down[i]):
                found[i] = np.nan


@kernel
def normal_equations(grey, found, across, down, sums):
    """Write the normal equations of a shift, with gain and offset eliminated.

    Args:
        grey: (k,) grey values of the patch.
        found: (k,) those of the image; NaN where there are none.
        across: (k,) gradient along x.
        down: (k,) gradient along y.
        sums: (6,) for the sums xx, xy, yy of the gradients, rx, ry with the residual, and its sum of squares.

    Returns:
        The number of pixels, the gain, and the sum of squares of the patch's grey values about their mean.
    """
    gain, offset, aa, _, _ = fit_gain(grey, found)
    count, ga, gd, mean = 0, 0.0, 0.0, 0.0
    for i in range(len(grey)):
        if found[i] == found[i]:
            count += 1
            ga += across[i]
            gd += down[i]
            mean += grey[i]
    ga, gd, mean, ca, cd = ga / count, gd / count, mean / count, 0.0, 0.0
    for i in range(len(grey)):
        if found[i] == found[i]:
            ca += across[i] * (grey[i] - mean)
            cd += down[i] * (grey[i] - mean)
    sums[:] = 0.0
    for i in range(len(grey)):
        if found[i] == found[i] and aa > 0:
            a = across[i] - ga - ca / aa * (grey[i] - mean)
            d = down[i] - gd - cd / aa * (grey[i] - mean)
            r = found[i] - gain * grey[i] - offset
            sums[0] += a * a
            sums[1] += a * d
            sums[2] += d * d
            sums[3] += a * r
            sums[4] += d * r
            sums[5] += r * r
    return count, gain, aa


@kernel
def without_idle_gradients(xx, xy, yy, idle):
    """Subtract what the gradients of noise alone would seem to tell, and set a negative eigenvalue to zero."""
    xx, yy = xx - idle, yy - idle
    half, away = 0.5 * (xx + yy), math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    if half + away <= 0:
        return 0.0, 0.0, 0.0
    if half - away >= 0:
        return xx, xy, yy
    strength, c, s = half + away, 0.5 * (xx - yy) + away, xy
    norm = math.sqrt(c * c + s * s)
    if norm > 0:
        c, s = c / norm, s / norm
    else:
        c, s = (1.0, 0.0) if xx >= yy else (0.0, 1.0)
    return strength * c * c, strength * c * s, strength * s * s


@kernel
def find_shift(image, pixels, used, grey, first_x, first_y, least_pixels, least_noise, found, across, down, sums):
    """Find the shift of one patch by Gauss-Newton from a start.

    Returns:
        Whether it was found; the shift; the variance of the difference; the number of pixels; the contrast.
    """
    x, y = first_x, first_y
    for step in range(STEPS + 1):
        if take_grey(image, pixels, used, x, y, found) < least_pixels:
            break
        take_gradients(image, pixels, x, y, found, across, down)
        count = 0
        for i in range(len(found)):
            if found[i] == found[i]:
                count += 1
        if count < least_pixels:
            break
        count, gain, aa = normal_equations(grey, found, across, down, sums)
        if aa <= 0 or gain <= 0:
            break
        variance = max(sums[5] / max(count - 4, 1), least_noise)
        prior = variance / DISTINCT_PIXELS / PRIOR_PX**2
        gx, gy = sums[3] + prior * (x - first_x), sums[4] + prior * (y - first_y)
        determinant = (sums[0] + prior) * (sums[2] + prior) - sums[1] ** 2
        sx = ((sums[2] + prior) * gx - sums[1] * gy) / determinant
        sy = ((sums[0] + prior) * gy - sums[1] * gx) / determinant
        length = math.sqrt(sx * sx + sy * sy)
        if step == STEPS or length < STOP_PX:
            return True, x, y, variance, count, gain * gain * aa / count
        scale = 1.0 / max(length, 1.0)
        x, y = x - scale * sx, y - scale * sy
    return False, x, y, 0.0, 0, 0.0


@kernel
def write_matches(
    image, pixels, used, grey, start, search, least_pixels, least_noise, shift, information, noise, contrast
):  # fmt: skip
    """Write the shifts of all patches, see `match_patches`."""
    size = pixels.shape[1]
    found, across, down, sums = np.empty(size), np.empty(size), np.empty(size), np.empty(6)
    for n in range(len(pixels)):
        known, x, y = search_whole_pixels(
            image, pixels[n], used[n], grey[n], start[n, 0], start[n, 1], search, least_pixels, found
        )
        if not known:
            continue
        known, x, y, variance, count, shown = find_shift(
            image, pixels[n], used[n], grey[n], x, y, least_pixels, least_noise, found, across, down, sums
        )
        if not known:
            continue
        xx, xy, yy = without_idle_gradients(sums[0], sums[1], sums[2], NOISE_IN_GRADIENTS * variance * count)
        if xx + yy <= 0:
            continue
        scale = DISTINCT_PIXELS / variance
        shift[n, 0], shift[n, 1] = x, y
        information[n, 0, 0], information[n, 1, 1] = scale * xx, scale * yy
        information[n, 0, 1] = information[n, 1, 0] = scale * xy
        noise[n], contrast[n] = variance, shown
