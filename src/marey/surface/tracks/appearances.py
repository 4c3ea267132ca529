"""Appearances: image patches of tracked points, cut out when the points were last measured reliably.

A point is matched to its own appearance for as long as it resembles it, so that errors do not accumulate over the
frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.images.matching.scanning import Pyramid, pyramid_of
from marey.images.matching.splines import SplinePicture, spline_of
from marey.kernels import kernel

ARRAYS = ("tiles", "centres", "maps")
"""Names of the arrays of `Appearances`, in saved results too."""
TILE_MARGIN = 2
"""Number of spline coefficients that a patch needs beyond its edge, which the cubic spline determines [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """One camera's picture of one frame, ready to be scanned and matched."""

    spline: SplinePicture
    pyramid: Pyramid


def picture_of(image: np.ndarray) -> Picture:
    """Prepare a grey picture (H, W)."""
    return Picture(spline=spline_of(image), pyramid=pyramid_of(image))


@dataclass(frozen=True, eq=False, kw_only=True)
class Appearances:
    """What N points looked like in C cameras, each in a picture of its own choice."""

    tiles: Floats
    """(N, C, T, T) float32 spline coefficients about each point; NaN where a camera has never seen it."""
    centres: Floats
    """(N, C, 2) where in its tile the point lies [px]."""
    maps: Floats
    """(N, C, 2, 2) now from then: the linear part of the affine map from the tile to the present picture."""

    def __len__(self) -> int:
        """Count the points."""
        return len(self.tiles)

    def __getitem__(self, which: Mask | Integers) -> "Appearances":
        return Appearances(tiles=self.tiles[which], centres=self.centres[which], maps=self.maps[which])

    @property
    def known(self) -> Mask:
        """(N, C) whether a camera has ever seen the point."""
        return np.isfinite(self.centres[..., 0])

    def picture(self, view: int) -> tuple[SplinePicture, Floats]:
        """Give one camera's tiles as one picture, one below the other, and where in it the points lie (N, 2) [px]."""
        tall = self.tiles[:, view].reshape(-1, self.tiles.shape[-1])
        centres = self.centres[:, view].copy()
        centres[:, 1] += np.arange(len(self)) * self.tiles.shape[-1]
        return SplinePicture(coefficients=tall), centres

    def patches(self, view: int, *, size: int) -> Floats:
        """Draw what the points should look like now (N, size, size) [grey levels], for a scan."""
        drawn = np.empty((len(self), size, size), np.float32)
        _draw(self.tiles[:, view], self.centres[:, view], self.maps[:, view], drawn)
        return drawn


def unknown(count: int, cameras: int, *, half: int) -> Appearances:
    """Give points that nobody has seen yet."""
    side = 2 * (half + TILE_MARGIN) + 1
    tiles = np.full((count, cameras, side, side), np.nan, np.float32)
    maps = np.tile(np.eye(2), (count, cameras, 1, 1))
    return Appearances(tiles=tiles, centres=np.full((count, cameras, 2), np.nan), maps=maps)


def renewed(appearances: Appearances, pictures: Sequence[Picture], pixels: Floats, which: Mask) -> Appearances:
    """Cut points out of new pictures.

    Args:
        appearances: Of N points so far.
        pictures: C of the present frame.
        pixels: (N, C, 2) where they show the points [px].
        which: (N, C) those to be cut out anew; where a tile would reach beyond the picture the old one stays.

    Returns:
        The appearances; their maps begin with the identity where they are new.
    """
    tiles, centres, maps = appearances.tiles.copy(), appearances.centres.copy(), appearances.maps.copy()
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
        maps[rows, view] = np.eye(2)
    return Appearances(tiles=tiles, centres=centres, maps=maps)


def joined(first: Appearances, second: Appearances) -> Appearances:
    """Put more points behind those that are there."""
    return Appearances(**{name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in ARRAYS})


@kernel
def _draw(tiles, centres, maps, drawn):
    """Draw patches by going back through each map; what lies beyond a tile takes the value of its edge."""
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
                # The coefficients are what the picture is, a little sharper: near enough for a scan.
                x, y = min(max(x, 0.0), last + 0.999), min(max(y, 0.0), last + 0.999)
                k, m = int(x), int(y)
                p, q = x - k, y - m
                upper = tiles[n, m, k] + p * (tiles[n, m, k + 1] - tiles[n, m, k])
                lower = tiles[n, m + 1, k] + p * (tiles[n, m + 1, k + 1] - tiles[n, m + 1, k])
                drawn[n, i + half, j + half] = upper + q * (lower - upper)
