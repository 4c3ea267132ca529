"""Evidence of a pixel for the person: log p_person - log p_rest, the rest being background, perhaps in shadow."""

from math import lgamma, log, pi

import cv2
import numba
import numpy as np

from marey.images.background import Background, Exposure
from marey.images.densities import COMMON, RATIO_BINS, RATIO_RANGE, Appearance

FREEDOM = 5.0
"""Degrees of freedom of the t distribution of what differs from the background: compression has heavy tails."""

SHADE_SLACK = 0.03
"""Within a few pixels the darkening of a shadow changes by this share."""

VEIL = 5.0
"""Reflections on floors and light thrown by the person change the background by about so many grey levels."""

SHADOW_SHARE = 0.2
VEIL_SHARE = 0.1
UNKNOWN_SHARE = 0.25
"""Shares of shadowed and veiled pixels in the rest, and of colours in the person that were not seen on it before."""

LIMIT = 10.0


def evidence(
    picture: np.ndarray, light: np.ndarray, background: Background, exposure: Exposure, appearance: Appearance
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

    Returns:
        (H, W) float32 evidence, positive for the person, at most LIMIT in size; (H, W) float32 the darkening where
        shadow explains the pixel better than plain background, elsewhere 0.
    """
    channels = picture.shape[2]
    # As large as a hand, wherever the camera stands: large enough to see the background's texture in it.
    reach = max(2, round(float(np.sqrt(background.size[0] * background.size[1])) / 80))
    window = (2 * reach + 1, 2 * reach + 1)
    product, square = _products(picture, light)
    shade = cv2.blur(product, window, borderType=cv2.BORDER_REPLICATE)
    shade /= cv2.blur(square, window, borderType=cv2.BORDER_REPLICATE)
    peak = lgamma((FREEDOM + channels) / 2) - lgamma(FREEDOM / 2) - channels / 2 * log(FREEDOM * pi)
    changes = np.arange(0, int(256 * np.sqrt(channels)) + 2)
    veil = VEIL_SHARE * np.exp(-changes / VEIL) / (8 * pi * VEIL**3 if channels == 3 else 2 * VEIL)
    uniform = UNKNOWN_SHARE * COMMON[channels] * 256.0**-channels
    person = ((1 - UNKNOWN_SHARE) * appearance.person + uniform).ravel().astype(np.float32)
    return _evidence(
        picture, light, background.steepness, background.trust, shade, reach, exposure.noise**2,
        np.float32(exposure.jitter**2), person, appearance.surroundings.ravel(), appearance.shadow,
        veil.astype(np.float32), np.float32(np.exp(peak)),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _products(picture, light):
    """Sums over the channels of picture times light and of light squared."""
    height, width, channels = picture.shape
    product, square = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            above, below = np.float32(0.0), np.float32(0.0)
            for c in range(channels):
                above += light[y, x, c] * np.float32(picture[y, x, c])
                below += light[y, x, c] * light[y, x, c]
            product[y, x], square[y, x] = above, below
    return product, square


@numba.njit(cache=True, nogil=True)
def _nearest_shade(shade, own, y, x, reach):
    """Of five windows about a pixel the darkening nearest to its own: a border does not spoil them all."""
    height, width = shade.shape
    best = shade[y, x]
    for dy, dx in ((-reach, 0), (reach, 0), (0, -reach), (0, reach)):
        row, column = min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)
        if abs(shade[row, column] - own) < abs(best - own):
            best = shade[row, column]
    return best


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _evidence(picture, light, steepness, trust, shade, reach, noise, jitter, person, around, shadow, veil, peak):
    height, width, channels = picture.shape
    result, darkening = np.empty((height, width), np.float32), np.zeros((height, width), np.float32)
    low, high = np.float32(RATIO_RANGE[0]), np.float32(RATIO_RANGE[1])
    to_bin, limit = np.float32(RATIO_BINS / (high - low)), np.float32(LIMIT)
    slack, per_freedom = np.float32(SHADE_SLACK**2 / channels), np.float32(1 / FREEDOM)
    one, share = np.float32(1.0), np.float32(SHADOW_SHARE * 2.5)
    for y in range(height):
        for x in range(width):
            index, above, below = 0, np.float32(0.0), np.float32(0.0)
            for c in range(channels):
                level, rest = np.float32(picture[y, x, c]), light[y, x, c]
                index = (index << 5) + (picture[y, x, c] >> 3) if channels == 3 else picture[y, x, c]
                above += level * rest
                below += rest * rest
            ratio = _nearest_shade(shade, above / below, y, x, reach)
            plain, shaded, change = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            plain_volume, shaded_volume, width_sum = one, one, np.float32(0.0)
            for c in range(channels):
                level, rest = np.float32(picture[y, x, c]), light[y, x, c]
                variance = noise[c] + jitter * steepness[y, x]
                difference, other = level - rest, level - ratio * rest
                change += difference * difference
                plain += difference * difference / variance
                plain_volume *= variance
                variance += slack * below
                shaded += other * other / variance
                shaded_volume *= variance
                width_sum += variance
            # (1 + m^2 / nu) to the power of (nu + C) / 2, 4 for colours and 3 for grey values.
            tail, dark_tail = one + plain * per_freedom, one + shaded * per_freedom
            tail *= tail * tail * (tail if channels == 3 else one)
            dark_tail *= dark_tail * dark_tail * (dark_tail if channels == 3 else one)
            density = peak / (np.sqrt(plain_volume) * tail)
            if low < ratio < high:
                # The t density takes the darkening for known; to within the noise it has 2.5 sd of its density.
                known = share * shadow[int((ratio - low) * to_bin)] * np.sqrt(width_sum / (channels * below))
                shadowed = known * peak / (np.sqrt(shaded_volume) * dark_tail)
                if shadowed > density:
                    darkening[y, x] = ratio
                density += shadowed
            density += veil[int(np.sqrt(change))]
            density = trust[y, x] * density + (one - trust[y, x]) * around[index]
            result[y, x] = min(max(np.log(person[index] / density), -limit), limit)
    return result, darkening
