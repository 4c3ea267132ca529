"""Appearances: image patches of tracked points, cut out when the points were last measured reliably.

A point is matched to its own appearance for as long as it resembles it, so that errors do not accumulate over the
frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.compiled.kernels import kernel
from marey.images.matching.scanning import Pyramid, pyramid_of
from marey.images.matching.splines import SplinePicture, spline_of

ARRAYS = ("tiles", "centres", "maps", "sd")
"""Names of the arrays of `Appearances`, in saved results too."""
TILE_MARGIN = 2
"""Number of spline coefficients that a patch needs beyond its edge, which the cubic spline determines [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """Image of one camera in one frame, prepared for scanning and matching."""

    spline: SplinePicture
    pyramid: Pyramid


def picture_of(image: np.ndarray) -> Picture:
    """Prepare a grey image (H, W)."""
    return Picture(spline=spline_of(image), pyramid=pyramid_of(image))


@dataclass(frozen=True, eq=False, kw_only=True)
class Appearances:
    """Image patches of N points in C cameras, each from the frame in which it was cut out."""

    tiles: Floats
    """(N, C, T, T) float32 spline coefficients about each point; NaN for cameras that have never seen it."""
    centres: Floats
    """(N, C, 2) position of the point in its tile [px]."""
    maps: Floats
    """(N, C, 2, 2) linear part of the affine map from the tile to the current image."""
    sd: Floats
    """(N, C) standard deviation of the point's place in its tile, which all matches with the tile have in common [px];
    NaN for cameras that have never seen it."""

    def __len__(self) -> int:
        """Count the points."""
        return len(self.tiles)

    def __getitem__(self, which: Mask | Integers) -> "Appearances":
        return Appearances(**{name: getattr(self, name)[which] for name in ARRAYS})

    @property
    def known(self) -> Mask:
        """(N, C) whether a camera has ever seen the point."""
        return np.isfinite(self.centres[..., 0])

    def picture(self, view: int, rows: Integers) -> tuple[SplinePicture, Floats]:
        """Stack one camera's tiles of n points to one image; return it and the points' positions in it (n, 2) [px]."""
        tall = self.tiles[rows, view].reshape(-1, self.tiles.shape[-1])
        centres = self.centres[rows, view]
        centres[:, 1] += np.arange(len(rows)) * self.tiles.shape[-1]
        return SplinePicture(coefficients=tall), centres

    def patches(self, view: int, rows: Integers, *, size: int) -> Floats:
        """Predict the current patches of n points (n, size, size) [grey levels], for a scan."""
        drawn = np.empty((len(rows), size, size), np.float32)
        _draw(self.tiles[rows, view], self.centres[rows, view], self.maps[rows, view], drawn)
        return drawn


def unknown(count: int, cameras: int, *, half: int) -> Appearances:
    """Return the appearances of points that no camera has seen yet."""
    side = 2 * (half + TILE_MARGIN) + 1
    tiles = np.full((count, cameras, side, side), np.nan, np.float32)
    maps = np.tile(np.eye(2), (count, cameras, 1, 1))
    return Appearances(
        tiles=tiles, centres=np.full((count, cameras, 2), np.nan), maps=maps, sd=np.full((count, cameras), np.nan)
    )  # fmt: skip


def renewed(
    appearances: Appearances, pictures: Sequence[Picture], pixels: Floats, sd: Floats, which: Mask
) -> Appearances:
    """Cut patches of points out of new images.

    Args:
        appearances: Appearances of N points so far.
        pictures: Images of the C cameras in the current frame.
        pixels: (N, C, 2) positions of the points in the images [px].
        sd: (N, C) standard deviations of these positions [px].
        which: (N, C) patches to be replaced; if a new tile would extend beyond the image, the old one stays.

    Returns:
        The appearances; the maps of new patches are the identity.
    """
    tiles, centres, maps, own = (getattr(appearances, name).copy() for name in ARRAYS)
    reach = np.arange(tiles.shape[-1]) - tiles.shape[-1] // 2
    for view, picture in enumerate(pictures):
        coefficients = picture.spline.coefficients
        rows = np.flatnonzero(which[:, view] & np.isfinite(pixels[:, view]).all(axis=1))
        whole = np.floor(pixels[rows, view]).astype(np.int64)
        high, wide = np.array(coefficients.shape) - 1 - tiles.shape[-1] // 2
        inside = (whole >= tiles.shape[-1] // 2).all(axis=1) & (whole[:, 0] <= wide) & (whole[:, 1] <= high)
        rows, whole = rows[inside], whole[inside]
        tiles[rows, view] = coefficients[(whole[:, 1, None] + reach)[:, :, None], (whole[:, 0, None] + reach)[:, None]]
        centres[rows, view] = pixels[rows, view] - whole + tiles.shape[-1] // 2
        maps[rows, view], own[rows, view] = np.eye(2), sd[rows, view]
    return Appearances(tiles=tiles, centres=centres, maps=maps, sd=own)


def joined(first: Appearances, second: Appearances) -> Appearances:
    """Append the appearances of further points."""
    return Appearances(**{name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in ARRAYS})


@kernel
def _draw(tiles, centres, maps, drawn):
    """Draw patches through the inverse of each map; beyond a tile the value at its edge is used."""
    half, last = drawn.shape[1] // 2, tiles.shape[1] - 2
    for n in range(drawn.shape[0]):
        a, b, c, d = maps[n, 0, 0], maps[n, 0, 1], maps[n, 1, 0], maps[n, 1, 1]
        area = a * d - b * c
        if not (area > 0.05 and area < 20.0 and centres[n, 0] >= 0):
            drawn[n] = np.nan
            continue
        for i in range(-half, half + 1):
            for j in range(-half, half + 1):
                x = centres[n, 0] + (d * j - b * i) / area
                y = centres[n, 1] + (a * i - c * j) / area
                # The coefficients are a slightly sharpened image, which suffices for a scan.
                x, y = min(max(x, 0.0), last + 0.999), min(max(y, 0.0), last + 0.999)
                k, m = int(x), int(y)
                p, q = x - k, y - m
                upper = tiles[n, m, k] + p * (tiles[n, m, k + 1] - tiles[n, m, k])
                lower = tiles[n, m + 1, k] + p * (tiles[n, m + 1, k + 1] - tiles[n, m + 1, k])
                drawn[n, i + half, j + half] = upper + q * (lower - upper)
