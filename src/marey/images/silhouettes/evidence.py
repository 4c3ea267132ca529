"""Evidence of each pixel for the person: log p_person - log p_rest, where the rest is background or its shadow."""

from math import exp, lgamma, log, pi

import cv2
import numpy as np

from marey.arrays import Mask
from marey.compiled.kernels import kernel
from marey.images.silhouettes.background import Background, Exposure
from marey.images.silhouettes.densities import COMMON, RATIO_BINS, RATIO_RANGE, Appearance, LocalDensities

# Constants rather than a settings record: the kernels are compiled with them.
FREEDOM = 5.0
"""Degrees of freedom of the t distribution of differences from the background: compression has heavy tails. Chosen by
hand."""

SHADE_SLACK = 0.03
"""Standard deviation of a shadow's darkening within a few pixels, as a share of the light. Chosen by hand."""

VEIL_SLACK = 0.3
"""Standard deviation of a veil's strength within a few pixels, as a share of it. Chosen by hand."""
VEIL = 8.0
"""Mean strength of a veil: of reflections on floors and of light reflected by the person [grey levels]. Chosen by
hand."""

SHADOW_SHARE = 0.2
"""Prior probability that a pixel outside the person is in shadow. Chosen by hand."""
VEIL_SHARE = 0.3
"""Prior probability that a pixel outside the person is veiled. Chosen by hand."""
UNKNOWN_SHARE = 0.25
"""Prior probability that a pixel of the person has a colour not observed on the person before. Chosen by hand."""

LIMIT = 10.0
"""Largest absolute value of a pixel's evidence, a natural logarithm. Chosen by hand."""


def evidence(
    picture: np.ndarray,
    light: np.ndarray,
    background: Background,
    exposure: Exposure,
    appearance: Appearance,
    *,
    near: Mask | None = None,
    local: LocalDensities | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the log-ratio of the densities of the person and of everything else for each pixel.

    Outside the person a pixel is one of these:

    - background with the exposure of this image (t distribution, whose width follows from noise and gradient);
    - shadow on the background, darkened by a factor that is constant over some pixels, so that colour and texture stay;
    - background under a veil, a change by a few grey levels of any colour (exponential in its size): a reflection;
    - any colour of the surroundings, with the probability that the background is wrong there.

    Args:
        picture: (H, W, C) uint8 image.
        light: (H, W, C) float32 background with the exposure of this image.
        background: Background model of the same size.
        exposure: Exposure of the image.
        appearance: Densities of the person's and the surroundings' colours and of the shadows.
        near: (H, W) pixels that can belong to the person; the others have -LIMIT.
        local: Densities that depend on the place, of the image's size; by default those of `appearance` alone.

    Returns:
        (H, W) float32 evidence, positive for the person, at most LIMIT in size; (H, W) float32 light ratio where
        shadow explains the pixel better than plain background, elsewhere 0.
    """
    channels = picture.shape[2]
    near = np.ones(picture.shape[:2], bool) if near is None else near
    # About the size of a hand, independent of the resolution: large enough to contain the background's texture.
    reach = max(2, round(float(np.sqrt(background.size[0] * background.size[1])) / 80))
    levels, rests = _planes(picture), _planes(light)
    product, square, change = _products(levels, rests)
    shade = _mean_around(product, reach)
    shade /= _mean_around(square, reach)
    peak = lgamma((FREEDOM + channels) / 2) - lgamma(FREEDOM / 2) - channels / 2 * log(FREEDOM * pi)
    changes = np.arange(0, int(256 * np.sqrt(channels)) + 2)
    veil = VEIL_SHARE * np.exp(-changes / VEIL) / (8 * pi * VEIL**3 if channels == 3 else 2 * VEIL)
    uniform = UNKNOWN_SHARE * COMMON[channels] * 256.0**-channels
    person = ((1 - UNKNOWN_SHARE) * appearance.person + uniform).ravel().astype(np.float32)
    nothing = np.zeros((0, 0), np.float32)
    of_person, of_rest = (nothing, nothing), (nothing, nothing)
    if local is not None:
        known = np.float32(1 - UNKNOWN_SHARE) * local.person + np.float32(uniform)
        of_person = known, local.person_share
        of_rest = local.surroundings, local.surroundings_share
    found: tuple[np.ndarray, np.ndarray] = _evidence(
        levels, near, rests, background.steepness, background.confidence, _wider(shade, reach),
        np.stack([_wider(_mean_around(plane, reach), reach) for plane in change]), reach, exposure.noise**2,
        np.float32(exposure.jitter**2), person, appearance.surroundings.ravel(), appearance.shadow,
        veil.astype(np.float32), np.float32(np.exp(peak)), of_person, of_rest,
    )  # fmt: skip
    return found


def _planes(picture: np.ndarray) -> np.ndarray:
    """Split an image (H, W, C) into planes (C, H, W)."""
    planes = np.empty((picture.shape[2], *picture.shape[:2]), picture.dtype)
    cv2.split(picture, list(planes))
    return planes


def _mean_around(plane: np.ndarray, reach: int) -> np.ndarray:
    return cv2.blur(plane, (2 * reach + 1, 2 * reach + 1), borderType=cv2.BORDER_REPLICATE)


def _wider(plane: np.ndarray, reach: int) -> np.ndarray:
    """Extend a plane by its first and last column, so that pixels to the left and right always exist."""
    return cv2.copyMakeBorder(plane, 0, 0, reach, reach, cv2.BORDER_REPLICATE)


@kernel(fastmath=True)
def _products(levels, rests):
    """Sum image times light and light squared over the channels (H, W); return also image minus light (C, H, W)."""
    channels, height, width = levels.shape
    product, square = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    change = np.empty((channels, height, width), np.float32)
    for c in range(channels):
        for y in range(height):
            level, rest, above, below, own = levels[c, y], rests[c, y], product[y], square[y], change[c, y]
            for x in range(width):
                above[x] += rest[x] * np.float32(level[x])
                below[x] += rest[x] * rest[x]
                own[x] = np.float32(level[x]) - rest[x]
    return product, square, change


# The following kernels process a row of pixels at a time, channel by channel and without branches, so that the compiler
# vectorises the loops. To avoid divisions, fractions are added over a common denominator, the product of the variances.


@kernel(fastmath=True, error_model="numpy")
def _add_plain(level, rest, steepness, noise, jitter, misfit, volume, above, below):
    """Add a channel's squared distance from the background, in standard deviations, times the product of variances."""
    for x in range(level.shape[0]):
        own, light = np.float32(level[x]), rest[x]
        variance = noise + jitter * steepness[x]
        difference = own - light
        misfit[x] = misfit[x] * variance + difference * difference * volume[x]
        volume[x] *= variance
        above[x] += own * light
        below[x] += light * light


@kernel(fastmath=True, error_model="numpy")
def _nearest_shade(above, below, here, up, down, left, right, ratio, pick):
    """Choose among five windows about a pixel the darkening nearest to its own: a border affects only some of them."""
    for x in range(here.shape[0]):
        own = above[x] / below[x]
        best, at = here[x], np.int32(0)
        gap = abs(best - own)
        other = abs(up[x] - own)
        best, at, gap = (up[x], np.int32(1), other) if other < gap else (best, at, gap)
        other = abs(down[x] - own)
        best, at, gap = (down[x], np.int32(2), other) if other < gap else (best, at, gap)
        other = abs(left[x] - own)
        best, at, gap = (left[x], np.int32(3), other) if other < gap else (best, at, gap)
        other = abs(right[x] - own)
        best, at = (right[x], np.int32(4)) if other < gap else (best, at)
        ratio[x], pick[x] = best, at


@kernel(inline="always", fastmath=True, error_model="numpy")
def _tail(misfit, volume, channels):
    """Return (1 + m^2 / nu)^(-(nu + C) / 2), m^2 = misfit / volume: the power is -4 for colours, -3 for grey values."""
    inverse = volume / (volume + misfit * np.float32(1 / FREEDOM))
    return inverse * inverse * inverse * (inverse if channels == 3 else np.float32(1.0))


@kernel(fastmath=True, error_model="numpy")
def _add_shadowed(level, rest, steepness, noise, jitter, slack, square, ratio, misfit, volume, widths):
    """Do as `_add_plain` for a shadow with this light ratio; also sum the variances."""
    for x in range(level.shape[0]):
        width = noise + slack * square[x] + jitter * steepness[x]
        difference = np.float32(level[x]) - ratio[x] * rest[x]
        misfit[x] = misfit[x] * width + difference * difference * volume[x]
        volume[x] *= width
        widths[x] += width


@kernel(fastmath=True, error_model="numpy")
def _shadow_density(channels, square, ratio, misfit, volume, widths, shadow, density):
    """Compute the density of a shadow with this light ratio, without the t density's peak."""
    low, high = np.float32(RATIO_RANGE[0]), np.float32(RATIO_RANGE[1])
    scale, last = np.float32(RATIO_BINS / (RATIO_RANGE[1] - RATIO_RANGE[0])), np.float32(RATIO_BINS - 1)
    for x in range(ratio.shape[0]):
        density[x] = shadow[np.int32(min(max((ratio[x] - low) * scale, np.float32(0.0)), last))]
    for x in range(ratio.shape[0]):
        # The t density assumes a known light ratio; its uncertainty by the noise covers 2.5 sd of the ratio's density.
        known = density[x] * np.sqrt(widths[x] / (np.float32(channels) * square[x] * volume[x]))
        value = np.float32(2.5 * SHADOW_SHARE) * known * _tail(misfit[x], volume[x], channels)
        density[x] = value if (ratio[x] > low) & (ratio[x] < high) else np.float32(0.0)


@kernel(fastmath=True, error_model="numpy")
def _add_veiled(level, rest, steepness, noise, jitter, here, up, down, left, right, pick, misfit, volume, strength):
    """Do as `_add_plain` for a veil with the mean change of the pixels around; also sum its squared strength."""
    for x in range(level.shape[0]):
        around = here[x]
        around = up[x] if pick[x] == 1 else around
        around = down[x] if pick[x] == 2 else around
        around = left[x] if pick[x] == 3 else around
        around = right[x] if pick[x] == 4 else around
        difference = np.float32(level[x]) - rest[x]
        variance = noise + jitter * steepness[x] + np.float32(VEIL_SLACK**2) * difference * difference
        left_over = difference - around
        misfit[x] = misfit[x] * variance + left_over * left_over * volume[x]
        volume[x] *= variance
        strength[x] += around * around


@kernel(fastmath=True, error_model="numpy")
def _veil_density(channels, misfit, volume, strength, veil, density):
    """Compute the density of a veil of these strengths."""
    for x in range(density.shape[0]):
        density[x] = veil[np.int32(np.sqrt(strength[x]))]
    for x in range(density.shape[0]):
        density[x] *= _tail(misfit[x], volume[x], channels)


@kernel(fastmath=True, error_model="numpy")
def _add_densities(channels, misfit, volume, ratio, shadow, veil, peak, rest, dark):
    """Sum the densities of all but the person; write the light ratio where shadow is likelier than plain background."""
    for x in range(rest.shape[0]):
        plain = peak * _tail(misfit[x], volume[x], channels) / np.sqrt(volume[x])
        # Where the plain background explains the pixel well, the other densities are ignored.
        badly = misfit[x] > np.float32(2 * channels) * volume[x]
        shade = peak * shadow[x] if badly else np.float32(0.0)
        dark[x] = ratio[x] if shade > plain else np.float32(0.0)
        rest[x] = plain + shade + (veil[x] if badly else np.float32(0.0))


@kernel(fastmath=True, error_model="numpy")
def _add_colour(levels, y, start, colour):
    """Write the index of each pixel's colour in the densities."""
    if levels.shape[0] == 1:
        for x in range(colour.shape[0]):
            colour[x] = levels[0, y, start + x]
        return
    blue, green, red = levels[0, y], levels[1, y], levels[2, y]
    for x in range(colour.shape[0]):
        at = start + x
        colour[x] = (np.int32(blue[at]) >> 3 << 10) + (np.int32(green[at]) >> 3 << 5) + (np.int32(red[at]) >> 3)


@kernel(fastmath=True, error_model="numpy")
def _take_densities(table, colour, local, share, y, start, density):
    """Write the density of each pixel's colour: the table's, or its mean with the local one where there is one."""
    for x in range(density.shape[0]):
        density[x] = table[colour[x]]
    if local.shape[0] > 0:
        own, weight = local[y], share[y]
        for x in range(density.shape[0]):
            density[x] += weight[start + x] * (own[start + x] - density[x])


@kernel(fastmath=True, error_model="numpy")
def _take_ratio(confidence, person, around, rest):
    """Divide the person's density by that of everything else, which is in `rest`, and clip the ratio to the limit."""
    one, least, most = np.float32(1.0), np.float32(exp(-LIMIT)), np.float32(exp(LIMIT))
    for x in range(rest.shape[0]):
        below = max(confidence[x] * rest[x] + (one - confidence[x]) * around[x], np.float32(1e-30))
        rest[x] = min(max(person[x], least * below), most * below) / below


@kernel(fastmath=True)
def _take_log(values, bits, exponent):
    """Replace positive numbers by their logarithms, to within rounding.

    Ours, because the standard function is not vectorised. values = m 2^e with m from sqrt(1/2) to sqrt(2), and
    log m = 2 artanh(s) with s = (m - 1) / (m + 1), |s| < 0.172, whose series is cut after s^9.
    """
    low = np.int32(0x3F3504F3)
    for x in range(values.shape[0]):
        shifted = bits[x] - low
        exponent[x] = np.float32(shifted >> np.int32(23))
        bits[x] = (shifted & np.int32(0x007FFFFF)) + low
    for x in range(values.shape[0]):
        s = (values[x] - np.float32(1.0)) / (values[x] + np.float32(1.0))
        q = s * s
        series = np.float32(2 / 7) + q * np.float32(2 / 9)
        series = np.float32(2.0) + q * (np.float32(2 / 3) + q * (np.float32(2 / 5) + q * series))
        values[x] = s * series + exponent[x] * np.float32(log(2.0))


@kernel
def _ends(near):
    """Return the first column of a row that is near and the one after the last; both 0 if there is none."""
    start, stop = 0, near.shape[0]
    while start < stop and not near[start]:
        start += 1
    if start == stop:
        return 0, 0
    while not near[stop - 1]:
        stop -= 1
    return start, stop


@kernel(fastmath=True, error_model="numpy")
def _evidence(
    levels, near, rests, steepness, confidence, shade, change, reach, noise, jitter, person, around, shadow, veil, peak,
    of_person, of_rest,
):  # fmt: skip
    channels, height, width = levels.shape
    result = np.full((height, width), np.float32(-LIMIT))
    darkening = np.zeros((height, width), np.float32)
    rows, pick_row, colour_row = np.empty((14, width), np.float32), np.empty(width, np.int32), np.empty(width, np.int32)
    slack = np.float32(SHADE_SLACK**2 / channels)
    for y in range(height):
        a, b = _ends(near[y])
        if a == b:
            continue
        n, high, low = b - a, max(y - reach, 0), min(y + reach, height - 1)
        rows[:10, :n] = np.float32(0.0)
        rows[10:13, :n] = np.float32(1.0)
        misfit, above, below = rows[0, :n], rows[1, :n], rows[2, :n]
        dark_misfit, widths, veil_misfit, strength = rows[3, :n], rows[4, :n], rows[5, :n], rows[6, :n]
        ratio, dark, veiled = rows[7, :n], rows[8, :n], rows[9, :n]
        volume, dark_volume, veil_volume, rest = rows[10, :n], rows[11, :n], rows[12, :n], rows[13, :n]
        pick, colour, steep = pick_row[:n], colour_row[:n], steepness[y, a:b]
        for c in range(channels):
            _add_plain(levels[c, y, a:b], rests[c, y, a:b], steep, noise[c], jitter, misfit, volume, above, below)
        _nearest_shade(
            above, below, shade[y, reach + a : reach + b], shade[high, reach + a : reach + b],
            shade[low, reach + a : reach + b], shade[y, a:b], shade[y, 2 * reach + a : 2 * reach + b], ratio, pick,
        )  # fmt: skip
        for c in range(channels):
            level, light, plane = levels[c, y, a:b], rests[c, y, a:b], change[c]
            _add_shadowed(level, light, steep, noise[c], jitter, slack, below, ratio, dark_misfit, dark_volume, widths)
            _add_veiled(
                level, light, steep, noise[c], jitter, plane[y, reach + a : reach + b],
                plane[high, reach + a : reach + b], plane[low, reach + a : reach + b], plane[y, a:b],
                plane[y, 2 * reach + a : 2 * reach + b], pick, veil_misfit, veil_volume, strength,
            )  # fmt: skip
        _shadow_density(channels, below, ratio, dark_misfit, dark_volume, widths, shadow, dark)
        _veil_density(channels, veil_misfit, veil_volume, strength, veil, veiled)
        _add_densities(channels, misfit, volume, ratio, dark, veiled, peak, rest, above)
        _add_colour(levels, y, a, colour)
        _take_densities(person, colour, of_person[0], of_person[1], y, a, dark_misfit)
        _take_densities(around, colour, of_rest[0], of_rest[1], y, a, widths)
        _take_ratio(confidence[y, a:b], dark_misfit, widths, rest)
        _take_log(rest, rest.view(np.int32), below)
        for x in range(n):
            if near[y, a + x]:
                result[y, a + x] = min(max(rest[x], np.float32(-LIMIT)), np.float32(LIMIT))
                darkening[y, a + x] = above[x]
    return result, darkening
