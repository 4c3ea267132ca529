"""Evidence of a pixel for the person: log p_person - log p_rest, the rest being background, perhaps in shadow."""

from math import exp, lgamma, log, pi

import cv2
import numba
import numpy as np

from marey.arrays import Mask
from marey.images.background import Background, Exposure
from marey.images.densities import COMMON, RATIO_BINS, RATIO_RANGE, Appearance

FREEDOM = 5.0
"""Degrees of freedom of the t distribution of what differs from the background: compression has heavy tails."""

SHADE_SLACK = 0.03
"""Within a few pixels the darkening of a shadow changes by this share."""

VEIL_SLACK = 0.3
VEIL = 8.0
"""Reflections on floors and light thrown by the person change the background by about so many grey levels."""

SHADOW_SHARE = 0.2
VEIL_SHARE = 0.3
UNKNOWN_SHARE = 0.25
"""Shares of shadowed and veiled pixels in the rest, and of colours in the person that were not seen on it before."""

LIMIT = 10.0


def evidence(
    picture: np.ndarray,
    light: np.ndarray,
    background: Background,
    exposure: Exposure,
    appearance: Appearance,
    *,
    near: Mask | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Log-ratio of the densities of the person and of everything else, for each pixel.

    Outside the person a pixel is one of these:

    - background as this picture exposes it (t distribution; noise and steepness of the background make its width);
    - a shadow on it, darkened by a factor that is the same for some pixels around, so that colour and texture stay;
    - background under a veil, a change by a few grey levels of any colour (exponential in its size): a reflection;
    - any colour of the surroundings, as far as the background is not to be trusted there.

    Args:
        picture: (H, W, C) uint8.
        light: (H, W, C) float32 the background as this picture exposes it.
        background: The empty picture, of the same size.
        exposure: How the picture exposes it.
        appearance: Colours of the person and of the surroundings, strengths of the shadows.
        near: (H, W) pixels that can belong to the person; the others have -LIMIT.

    Returns:
        (H, W) float32 evidence, positive for the person, at most LIMIT in size; (H, W) float32 the darkening where
        shadow explains the pixel better than plain background, elsewhere 0.
    """
    channels = picture.shape[2]
    near = np.ones(picture.shape[:2], bool) if near is None else near
    # As large as a hand, wherever the camera stands: large enough to see the background's texture in it.
    reach = max(2, round(float(np.sqrt(background.size[0] * background.size[1])) / 80))
    window = (2 * reach + 1, 2 * reach + 1)
    product, square, change = _products(picture, light)
    change = cv2.blur(change, window, borderType=cv2.BORDER_REPLICATE).reshape(picture.shape)
    shade = cv2.blur(product, window, borderType=cv2.BORDER_REPLICATE)
    shade /= cv2.blur(square, window, borderType=cv2.BORDER_REPLICATE)
    peak = lgamma((FREEDOM + channels) / 2) - lgamma(FREEDOM / 2) - channels / 2 * log(FREEDOM * pi)
    changes = np.arange(0, int(256 * np.sqrt(channels)) + 2)
    veil = VEIL_SHARE * np.exp(-changes / VEIL) / (8 * pi * VEIL**3 if channels == 3 else 2 * VEIL)
    uniform = UNKNOWN_SHARE * COMMON[channels] * 256.0**-channels
    person = ((1 - UNKNOWN_SHARE) * appearance.person + uniform).ravel().astype(np.float32)
    return _evidence(
        picture, near, light, background.steepness, background.trust, shade, change, reach, tuple(exposure.noise**2),
        np.float32(exposure.jitter**2), person, appearance.surroundings.ravel(), appearance.shadow,
        veil.astype(np.float32), np.float32(np.exp(peak)),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _products(picture, light):
    """Sums over the channels of picture times light and of light squared; picture less light."""
    height, width, channels = picture.shape
    product, square = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    change = np.empty((height, width, channels), np.float32)
    for y in range(height):
        for x in range(width):
            above, below = np.float32(0.0), np.float32(0.0)
            for c in range(channels):
                level, rest = np.float32(picture[y, x, c]), light[y, x, c]
                above += rest * level
                below += rest * rest
                change[y, x, c] = level - rest
            product[y, x], square[y, x] = above, below
    return product, square, change


@numba.njit(cache=True, nogil=True, fastmath=True)
def _nearest_shade(shade, own, y, x, reach):
    """Of five windows about a pixel the darkening nearest to its own: a border does not spoil them all."""
    height, width = shade.shape
    best, best_row, best_column = shade[y, x], y, x
    gap = abs(best - own)
    for dy, dx in ((-reach, 0), (reach, 0), (0, -reach), (0, reach)):
        row, column = min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)
        value = shade[row, column]
        # Choices instead of branches, which nobody could predict.
        nearer = abs(value - own) < gap
        gap = abs(value - own) if nearer else gap
        best = value if nearer else best
        best_row, best_column = row if nearer else best_row, column if nearer else best_column
    return best, best_row, best_column


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _tail(misfit, volume, channels):
    """(1 + m^2 / nu) to the power of -(nu + C) / 2, m^2 = misfit / volume: -4 for colours, -3 for grey values."""
    inverse = volume / (volume + misfit * np.float32(1 / FREEDOM))
    return inverse * inverse * inverse * (inverse if channels == 3 else np.float32(1.0))


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _plain(picture, light, y, x, noise, spread):
    """Squared distance from the background in standard deviations times the product of the variances; that product.

    Divisions are dear: the fractions are added over a common denominator.
    """
    misfit, volume = np.float32(0.0), np.float32(1.0)
    for c in range(len(noise)):
        difference = np.float32(picture[y, x, c]) - light[y, x, c]
        variance = noise[c] + spread
        misfit = misfit * variance + difference * difference * volume
        volume *= variance
    return misfit, volume


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _shadowed(picture, light, y, x, noise, spread, ratio, square, shadow):
    """Density of a shadow that leaves this share of the light, less the t density's peak."""
    low, high = np.float32(RATIO_RANGE[0]), np.float32(RATIO_RANGE[1])
    if not low < ratio < high:
        return np.float32(0.0)
    channels = len(noise)
    slack = np.float32(SHADE_SLACK**2 / channels) * square + spread
    misfit, volume, widths = np.float32(0.0), np.float32(1.0), np.float32(0.0)
    for c in range(channels):
        difference = np.float32(picture[y, x, c]) - ratio * light[y, x, c]
        width = noise[c] + slack
        misfit = misfit * width + difference * difference * volume
        volume *= width
        widths += width
    # The t density takes the darkening for known; to within the noise it has 2.5 sd of its density.
    place = min(int((ratio - low) * np.float32(RATIO_BINS / (high - low))), RATIO_BINS - 1)
    known = shadow[place] * np.sqrt(widths / (np.float32(channels) * square * volume))
    return np.float32(2.5 * SHADOW_SHARE) * known * _tail(misfit, volume, channels)


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _veiled(picture, light, y, x, noise, spread, change, row, column, veil):
    """Density of a veil that changes the pixels around by this much."""
    misfit, volume, strength = np.float32(0.0), np.float32(1.0), np.float32(0.0)
    for c in range(len(noise)):
        difference = np.float32(picture[y, x, c]) - light[y, x, c]
        around = change[row, column, c]
        rest = difference - around
        variance = noise[c] + spread + np.float32(VEIL_SLACK**2) * difference * difference
        misfit = misfit * variance + rest * rest * volume
        volume *= variance
        strength += around * around
    return veil[int(np.sqrt(strength))] * _tail(misfit, volume, len(noise))


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _log_ratio(above, below):
    """Logarithm of a ratio of densities, held within the limit; most pixels are beyond it and cost no logarithm."""
    if above <= np.float32(exp(-LIMIT)) * below:
        return np.float32(-LIMIT)
    if above >= np.float32(exp(LIMIT)) * below:
        return np.float32(LIMIT)
    return np.log(above / below)


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _evidence(
    picture, near, light, steepness, trust, shade, change, reach, noise, jitter, person, around, shadow, veil, peak
):
    # The noise comes as a tuple: its length is known when this is compiled, and the loops over channels unroll.
    (height, width), channels = near.shape, len(noise)
    result, darkening = np.empty((height, width), np.float32), np.zeros((height, width), np.float32)
    one = np.float32(1.0)
    for y in range(height):
        for x in range(width):
            if not near[y, x]:
                result[y, x] = np.float32(-LIMIT)
                continue
            index = 0
            for c in range(channels):
                index = (index << 5) + (picture[y, x, c] >> 3) if channels == 3 else picture[y, x, c]
            spread = jitter * steepness[y, x]
            misfit, volume = _plain(picture, light, y, x, noise, spread)
            density = peak * _tail(misfit, volume, channels) / np.sqrt(volume)
            # Where the plain background explains the pixel well the others add nothing.
            if misfit > np.float32(2 * channels) * volume:
                above, below = np.float32(0.0), np.float32(0.0)
                for c in range(channels):
                    above += np.float32(picture[y, x, c]) * light[y, x, c]
                    below += light[y, x, c] * light[y, x, c]
                ratio, row, column = _nearest_shade(shade, above / below, y, x, reach)
                dark = peak * _shadowed(picture, light, y, x, noise, spread, ratio, below, shadow)
                if dark > density:
                    darkening[y, x] = ratio
                density += dark + _veiled(picture, light, y, x, noise, spread, change, row, column, veil)
            density = trust[y, x] * density + (one - trust[y, x]) * around[index]
            result[y, x] = _log_ratio(person[index], density)
    return result, darkening
