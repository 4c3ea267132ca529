"""Scanning by cross-correlation: search of a patch in a box, to a pixel, from coarse to fine images.

The result is a start for `marey.images.matching.matching` if no better prediction is known ([Plaenkers1999] section
2.2).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats
from marey.compiled.kernels import kernel
from marey.images.matching.matching import share_out
from marey.lanes import POSITIONS, correlate_rows

_MIDDLE = np.float32(128.0)
"""Subtracted from the grey values, so that sums of squares in single precision stay exact [grey levels]."""
_FINEST = 8
"""Half-width of the largest box that is scanned at full resolution [px]; larger boxes are scanned in coarser levels
first. Chosen by hand."""
_CLOSER = 2
"""Half-width of the box scanned about the result of the next coarser level [px]. Chosen by hand."""
_COARSE = 7
"""Largest width and height of a patch in coarser levels [px]. Chosen by hand."""
_LEAST = 12
"""Least width and height of a level of the pyramid [px]. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Pyramid:
    """An image in several resolutions, each half of the one before."""

    levels: tuple[Floats, ...]
    """(h, w) float32 grey values minus 128, the full resolution first."""


def pyramid_of(image: np.ndarray, *, levels: int = 4) -> Pyramid:
    """Build the pyramid of a grey image.

    Args:
        image: (H, W) grey image.
        levels: Largest number of levels; fewer if the image becomes too small.

    Returns:
        The pyramid.
    """
    sizes: list[Floats] = [np.ascontiguousarray(image, np.float32) - _MIDDLE]
    while len(sizes) < levels and min(sizes[-1].shape) >= 2 * _LEAST:
        last = sizes[-1]
        even = last[: last.shape[0] // 2 * 2, : last.shape[1] // 2 * 2]
        smaller = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        sizes.append(np.asarray(smaller, np.float32))
    return Pyramid(levels=tuple(sizes))


def scan(
    template: Pyramid, search: Pyramid, pixels: Floats, expected: Floats, *, size: int, reach: float, threads: int = 1
) -> tuple[Floats, Floats]:
    """Search patches of one image in boxes of another.

    Args:
        template: The image from which the patches are taken.
        search: The image that is scanned.
        pixels: (n, 2) centres of the patches in the template [px].
        expected: (n, 2) centres of the boxes in the search image [px].
        size: Width and height of a patch, odd [px].
        reach: Half-width of a box [px].
        threads: Number of threads that share the patches.

    Returns:
        Best position of each patch (n, 2), to half a pixel [px], and the correlation there (n,); NaN if the patch, or
        every position of the box, extends beyond its image.
    """
    coarsest = 0
    while reach / 2**coarsest > _FINEST and coarsest + 1 < min(len(template.levels), len(search.levels)):
        coarsest += 1
    pixels, found = np.asarray(pixels, float), np.array(expected, float)
    score, nearer = np.full(len(pixels), np.nan), np.zeros(len(pixels), bool)
    for level in range(coarsest, -1, -1):
        side = size if level == 0 else min(size, _COARSE)
        box = min(math.ceil(reach / 2**level), _FINEST)
        for known in (False, True):
            rows = np.flatnonzero(nearer == known)
            place, score[rows] = _scan_level(
                template.levels[level], search.levels[level], _at_level(pixels[rows], level),
                _at_level(found[rows], level), side, _CLOSER if known else box, threads,
            )  # fmt: skip
            better = np.isfinite(score[rows])
            found[rows[better]] = _from_level(place[better], level)
        # A coarse patch may extend beyond the border although the fine one does not.
        nearer |= np.isfinite(score)
    found[~np.isfinite(score)] = np.nan
    return found, score


def _scan_level(
    template: Floats, search: Floats, pixels: Floats, expected: Floats, size: int, reach: int, threads: int
) -> tuple[Floats, Floats]:
    whole = np.round(np.nan_to_num(pixels, nan=-9.0))
    patches = patches_at(template, whole, size=size)
    found, score = scan_patches(patches, search, expected, reach=reach, threads=threads)
    return found + (pixels - whole), score


def scan_patches(
    patches: Floats, picture: Floats, expected: Floats, *, reach: int, threads: int = 1
) -> tuple[Floats, Floats]:
    """Scan boxes of an image for patches.

    Args:
        patches: (n, s, s) grey values.
        picture: (H, W) float32, a level of a `Pyramid`.
        expected: (n, 2) centres of the boxes [px].
        reach: Half-width of a box [px].
        threads: Number of threads that share the patches.

    Returns:
        Best pixels (n, 2) of the patches' centres, and the correlation there (n,); NaN where there is none.
    """
    found, score = np.full((len(patches), 2), np.nan), np.full(len(patches), np.nan)
    patches, expected = np.ascontiguousarray(patches, np.float32), np.ascontiguousarray(expected, float)

    def work(some: slice) -> None:
        _scan(patches[some], picture, expected[some], reach, found[some], score[some])

    share_out(work, len(patches), threads)
    return found, score


def patches_at(picture: Floats, pixels: Floats, *, size: int) -> Floats:
    """Cut patches out of an image.

    Args:
        picture: (H, W) float32 image.
        pixels: (n, 2) centres of the patches, whole numbers [px].
        size: Width and height of the patches, odd [px].

    Returns:
        (n, size, size) float32; NaN if a patch extends beyond the image.
    """
    half = size // 2
    inside = (pixels >= half).all(axis=1) & (pixels[:, 0] < picture.shape[1] - half)
    inside &= pixels[:, 1] < picture.shape[0] - half
    column, row = np.where(inside[:, None], pixels, half).astype(np.int64).T
    around = np.arange(-half, half + 1)
    patches = np.full((len(pixels), size, size), np.nan, np.float32)
    if inside.any():
        patches = picture[(row[:, None] + around)[:, :, None], (column[:, None] + around)[:, None, :]]
        patches[~inside] = np.nan
    return patches


def _at_level(pixels: Floats, level: int) -> Floats:
    return np.asarray((pixels + 0.5) / 2**level - 0.5)


def _from_level(pixels: Floats, level: int) -> Floats:
    return np.asarray((pixels + 0.5) * 2**level - 0.5)


@kernel
def _scan(patches, picture, expected, reach, found, score):
    """Find the best position of each patch among the whole pixels of its box."""
    size = patches.shape[1]
    half = size // 2
    height, width = picture.shape
    grey = np.empty((size, size), np.float32)
    blocks = (2 * reach + POSITIONS) // POSITIONS
    window = np.zeros((2 * reach + size + 1, POSITIONS * blocks + size), np.float32)
    total, square = np.empty(window.shape[1], np.float32), np.empty(window.shape[1], np.float32)
    cross = np.empty(2 * POSITIONS, np.float32)
    for n in range(patches.shape[0]):
        x, y = expected[n]
        if not (abs(x) < 1e8 and abs(y) < 1e8) or not _normalise(patches[n], grey):
            continue
        column, row = math.floor(x + 0.5), math.floor(y + 0.5)
        left, top = max(column - reach, half), max(row - reach, half)
        wide = min(column + reach, width - 1 - half) - left + 1
        high = min(row + reach, height - 1 - half) - top + 1
        if wide < 1 or high < 1:
            continue
        _cut_out(picture, top - half, left - half, high + size - 1, wide + size - 1, window)
        best, i, j = _best(grey, window, wide, high, total, square, cross)
        if best > -1.5:
            found[n, 0], found[n, 1], score[n] = left + j, top + i, best


@kernel
def _cut_out(picture, top, left, high, wide, window):
    """Copy a part of an image into the upper left of a window; the rest of the window keeps any numbers."""
    for i in range(high):
        source, target = picture[top + i, left : left + wide], window[i]
        for j in range(wide):
            target[j] = source[j]


@kernel
def _best(grey, window, wide, high, total, square, cross):
    """Return the largest correlation of a normalised patch in a window, and its row and column; -2 without texture."""
    size, (_, stride) = grey.shape[0], window.shape
    pixels = np.float32(size * size)
    best, row, column = np.float32(-2.0), 0, 0
    weights, flat = grey.reshape(size * size), window.reshape(window.size)
    for first in range(0, wide, POSITIONS):
        for i in range(0, high, 2):
            correlate_rows(weights, size, flat, i * stride + first, stride, cross)
            for r in range(i, min(i + 2, high)):
                _add_up(window, r, first, total, square, size)
                add, more = np.float32(0.0), np.float32(0.0)
                for k in range(size - 1):
                    add += total[k]
                    more += square[k]
                for k in range(min(POSITIONS, wide - first)):
                    add += total[k + size - 1]
                    more += square[k + size - 1]
                    power = more - add * add / pixels
                    value = np.float32(-2.0)
                    if power > 1e-3 * size * size:
                        value = np.float32(cross[(r - i) * POSITIONS + k] / math.sqrt(power))
                    if value > best:
                        best, row, column = value, r, first + k
                    add -= total[k]
                    more -= square[k]
    return best, row, column


@kernel
def _add_up(window, row, first, total, square, size):
    """Write the sums of the columns under the patch, and of their squares."""
    wide = POSITIONS + size - 1
    for k in range(wide):
        total[k] = square[k] = np.float32(0.0)
    for i in range(size):
        line = window[row + i, first : first + wide]
        for k in range(wide):
            total[k] += line[k]
            square[k] += line[k] * line[k]


@kernel
def _normalise(patch, grey):
    """Write a patch's grey values with mean 0 and norm 1; return false if it is flat or unknown."""
    mean = 0.0
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            mean += patch[i, j]
    mean /= patch.size
    power = 0.0
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            grey[i, j] = patch[i, j] - mean
            power += grey[i, j] ** 2
    if not power > 1e-3 * patch.size:
        return False
    scale = np.float32(1 / math.sqrt(power))
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            grey[i, j] *= scale
    return True
