"""Colour densities of the person and of its surroundings: histograms smoothed by a Gaussian.

[Rosenhahn2006] section 2.1 estimates the density of grey values in each region this way; with three channels the
histogram is a cube. All densities are per grey level of every channel, so that they are comparable with those of a
background model.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from marey.arrays import Mask, freeze_fields
from marey.compiled.kernels import kernel

COLOUR_SHIFT = 3
"""Binary logarithm of the side of a histogram cell: 8 grey levels, the standard deviation of the smoothing."""

RATIO_BINS = 64
"""Number of bins of the histogram of a shadow's darkening."""
RATIO_RANGE = (0.2, 1.1)
"""Range of the ratio of the light under a shadow to that without: a cast shadow keeps at least 20 % of the light, and
light reflected by a person can slightly increase it. Chosen by hand."""

SHADOW_DEPTH = 0.1
"""Expected share of the light removed by a shadow before any shadow was observed. Chosen by hand."""

COMMON = {1: 1.0, 3: 16.0}
"""Density of an unknown colour relative to the uniform density, by number of channels: real colours concentrate about
grey. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Appearance:
    """Densities of the colours of the person and its surroundings, and of the shadows, in one camera.

    Args:
        person: Smoothed density of the person's colours: (32, 32, 32), or (256,) for grey images.
        surroundings: The same for the surroundings.
        shadow: (64,) density of the shadows' light ratio over `RATIO_RANGE`, which integrates to one.
    """

    person: np.ndarray
    surroundings: np.ndarray
    shadow: np.ndarray

    def __post_init__(self):
        freeze_fields(self, "person", "surroundings", "shadow", dtype=np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalDensities:
    """Densities of each pixel's colour from what is known about its place in the image.

    Args:
        person: (H, W) density of the pixel's colour in the part of the person that is nearest.
        person_share: (H, W) weight of that density beside the one of the whole person, from 0 to 1.
        surroundings: (H, W) density of the pixel's colour in the surroundings near it.
        surroundings_share: (H, W) weight of that density beside the one of all surroundings, from 0 to 1.
        texture: (H, W) log-likelihood ratio of the pixel's texture; None if it is not known.
    """

    person: np.ndarray
    person_share: np.ndarray
    surroundings: np.ndarray
    surroundings_share: np.ndarray
    texture: np.ndarray | None = None

    def __post_init__(self):
        names = ("person", "person_share", "surroundings", "surroundings_share")
        freeze_fields(self, *names, *(() if self.texture is None else ("texture",)), dtype=np.float32)

    def within(self, roi: tuple[slice, slice]) -> "LocalDensities":
        """Return the densities of some rows and columns."""
        return LocalDensities(
            person=self.person[roi], person_share=self.person_share[roi],
            surroundings=self.surroundings[roi], surroundings_share=self.surroundings_share[roi],
            texture=None if self.texture is None else self.texture[roi],
        )  # fmt: skip


def unknown(channels: int) -> Appearance:
    """Return an uninformative appearance: uniform colours, and weak shadows more probable than strong ones."""
    uniform = np.full((256 >> COLOUR_SHIFT,) * 3 if channels == 3 else (256,), 256.0**-channels)
    return Appearance(person=uniform * COMMON[channels], surroundings=uniform, shadow=_shadow_prior())


@cache
def _shadow_prior() -> np.ndarray:
    low, high = RATIO_RANGE
    ratios = low + (np.arange(RATIO_BINS) + 0.5) * (high - low) / RATIO_BINS
    density = np.exp(-np.abs(ratios - 1) / np.where(ratios < 1, SHADOW_DEPTH, 0.03))
    return np.asarray(density / density.sum() * RATIO_BINS / (high - low))


def colour_density(image: np.ndarray, region: Mask) -> np.ndarray:
    """Estimate the smoothed colour density of a region.

    Args:
        image: (H, W, C) uint8, with C = 1 or 3.
        region: (H, W) true inside.

    Returns:
        (32, 32, 32) or (256,) float32, per grey level of every channel; uniform if the region is empty.
    """
    if image.shape[2] == 3:
        counts = _colour_counts(np.ascontiguousarray(image), np.ascontiguousarray(region))
        smooth, volume = _smooth_cube(counts, _kernel(1.0)), float(1 << 3 * COLOUR_SHIFT)
    else:
        counts = np.bincount(image[..., 0][region], minlength=256).astype(np.float32)
        smooth, volume = np.convolve(np.pad(counts, 20, mode="symmetric"), _kernel(8.0), "same")[20:-20], 1.0
    total = float(counts.sum())
    if total == 0:
        return np.full(counts.shape, COMMON[image.shape[2]] * 256.0 ** -image.shape[2], np.float32)
    return np.asarray((smooth / (total * volume)).astype(np.float32))


@cache
def _kernel(deviation: float) -> np.ndarray:
    reach = int(np.ceil(2.5 * deviation))
    weights = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * deviation**2))
    return np.asarray((weights / weights.sum()).astype(np.float32))


@kernel
def _colour_counts(image, region):
    counts = np.zeros((32, 32, 32), np.float32)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            if region[y, x]:
                counts[image[y, x, 0] >> 3, image[y, x, 1] >> 3, image[y, x, 2] >> 3] += np.float32(1.0)
    return counts


@kernel(fastmath=True)
def _smooth_cube(cube, kernel):
    """Convolve along the three axes; values that would leave the cube are added at its edge. Empty cells are skipped.

    The last axis is convolved first, while most cells are empty; along the others whole rows are added.
    """
    size, reach = cube.shape[0], kernel.size // 2
    last, middle, result = np.zeros(cube.shape, cube.dtype), np.zeros(cube.shape, cube.dtype), np.zeros_like(cube)
    used = np.zeros((size, size), np.bool_)
    for i in range(size):
        for j in range(size):
            for k in range(size):
                value = cube[i, j, k]
                if value != 0:
                    used[i, j] = True
                    for t in range(-reach, reach + 1):
                        last[i, j, min(max(k + t, 0), size - 1)] += kernel[t + reach] * value
    for i in range(size):
        filled = False
        for j in range(size):
            if used[i, j]:
                filled = True
                row = last[i, j]
                for t in range(-reach, reach + 1):
                    weight, out = kernel[t + reach], middle[i, min(max(j + t, 0), size - 1)]
                    for k in range(size):
                        out[k] += weight * row[k]
        if filled:
            plane = middle[i].ravel()
            for t in range(-reach, reach + 1):
                weight, out = kernel[t + reach], result[min(max(i + t, 0), size - 1)].ravel()
                for k in range(size * size):
                    out[k] += weight * plane[k]
    return result


def shadow_density(ratios: np.ndarray, *, strength: float = 500.0) -> np.ndarray:
    """Estimate the density of the light ratio under shadows.

    Args:
        ratios: (N,) image over background of the shadowed pixels.
        strength: Weight of the prior density, as a number of pixels.

    Returns:
        (64,) float32 density over `RATIO_RANGE`.
    """
    low, high = RATIO_RANGE
    seen = ratios[(ratios >= low) & (ratios <= high)]
    places = ((seen - low) * (RATIO_BINS / (high - low))).astype(np.int64)
    counts = np.bincount(np.minimum(places, RATIO_BINS - 1), minlength=RATIO_BINS).astype(float)
    mirrored = np.concatenate([counts[7::-1], counts, counts[:-9:-1]])
    smooth = np.convolve(mirrored, _kernel(3.0), "same")[8:-8]
    prior = _shadow_prior()
    scale = RATIO_BINS / (high - low)
    return np.asarray(((smooth * scale + strength * prior) / (counts.sum() + strength)).astype(np.float32))


def blended(old: Appearance, new: Appearance, share: float) -> Appearance:
    """Return the mean of two appearances, in which the new one has the weight `share`."""

    def mix(name: str) -> np.ndarray:
        return np.asarray((1 - share) * getattr(old, name) + share * getattr(new, name))

    return Appearance(person=mix("person"), surroundings=mix("surroundings"), shadow=mix("shadow"))
