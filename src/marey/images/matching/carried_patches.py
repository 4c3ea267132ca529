"""Matching of small patches whose pixels were carried from their first image to the present one by a moving surface.

The surface predicts where each pixel of the patch should be, so that its deformation is known; only a shift of the
entire patch, and gain and offset of its grey values, are estimated ([Lucas1981], with the image's own gradients).
"""

import math
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Mask
from marey.kernels import kernel

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
    """Return the shift on a grid of whole pixels about a start whose correlation, less the cost of distance, is best."""
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
def write_matches(
    image, pixels, used, grey, start, search, least_pixels, least_noise, shift, information, noise, contrast
):
    """Write the shifts of all patches, see `match_patches`."""
    size = pixels.shape[1]
    found, across, down = np.empty(size), np.empty(size), np.empty(size)
    for n in range(len(pixels)):
        known, x, y = search_whole_pixels(
            image, pixels[n], used[n], grey[n], start[n, 0], start[n, 1], search, least_pixels, found
        )
        if not known:
            continue
        first_x, first_y = x, y
        solved = True
        for step in range(STEPS + 1):
            if take_grey(image, pixels[n], used[n], x, y, found) < least_pixels:
                solved = False
                break
            for i in range(size):
                across[i] = down[i] = 0.0
                if found[i] == found[i]:
                    u, v = pixels[n, i, 0] + x, pixels[n, i, 1] + y
                    across[i] = 0.5 * (bilinear(image, u + 1, v) - bilinear(image, u - 1, v))
                    down[i] = 0.5 * (bilinear(image, u, v + 1) - bilinear(image, u, v - 1))
                    if not (across[i] == across[i] and down[i] == down[i]):
                        found[i] = np.nan
            gain, offset, aa, _, _ = fit_gain(grey[n], found)
            count, ga, gd, ca, cd, mean = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(size):
                if found[i] == found[i]:
                    count += 1
                    ga += across[i]
                    gd += down[i]
                    mean += grey[n, i]
            if count < least_pixels or aa <= 0 or gain <= 0:
                solved = False
                break
            ga, gd, mean = ga / count, gd / count, mean / count
            for i in range(size):
                if found[i] == found[i]:
                    ca += across[i] * (grey[n, i] - mean)
                    cd += down[i] * (grey[n, i] - mean)
            # Gradients without their parts along the patch's grey values and their mean: gain and offset are free.
            xx, xy, yy, rx, ry, squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(size):
                if found[i] == found[i]:
                    t = grey[n, i] - mean
                    a = across[i] - ga - ca / aa * t
                    d = down[i] - gd - cd / aa * t
                    r = found[i] - gain * grey[n, i] - offset
                    xx += a * a
                    xy += a * d
                    yy += d * d
                    rx += a * r
                    ry += d * r
                    squares += r * r
            variance = max(squares / max(count - 4, 1), least_noise)
            if step == STEPS:
                break
            prior = variance / DISTINCT_PIXELS / PRIOR_PX**2
            gx, gy = rx + prior * (x - first_x), ry + prior * (y - first_y)
            determinant = (xx + prior) * (yy + prior) - xy * xy
            sx = ((yy + prior) * gx - xy * gy) / determinant
            sy = ((xx + prior) * gy - xy * gx) / determinant
            length = math.sqrt(sx * sx + sy * sy)
            if length > 1.0:
                sx, sy = sx / length, sy / length
            if length < STOP_PX:
                break
            x -= sx
            y -= sy
        if not solved:
            continue
        # What the gradients of noise alone would seem to tell is no information.
        idle = NOISE_IN_GRADIENTS * variance * count
        xx, yy = xx - idle, yy - idle
        half, away = 0.5 * (xx + yy), math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        if half + away <= 0:
            continue
        if half - away < 0:
            # Only the better direction is known.
            strength = half + away
            c, s = 0.5 * (xx - yy) + away, xy
            norm = math.sqrt(c * c + s * s)
            c, s = (c / norm, s / norm) if norm > 0 else ((1.0, 0.0) if xx >= yy else (0.0, 1.0))
            xx, xy, yy = strength * c * c, strength * c * s, strength * s * s
        scale = DISTINCT_PIXELS / variance
        shift[n, 0], shift[n, 1] = x, y
        information[n, 0, 0] = scale * xx
        information[n, 0, 1] = information[n, 1, 0] = scale * xy
        information[n, 1, 1] = scale * yy
        noise[n] = variance
        contrast[n] = gain * gain * aa / count
