"""Sweep over depth: search of a pixel along its epipolar line by comparing patches at all depths."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.cameras.camera import Camera
from marey.compiled.kernels import kernel
from marey.geometry.vectors import unit
from marey.surface.points.settings import SURFACE_SEED_DEFAULTS, SurfaceSeedSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class Hypotheses:
    """Possible positions of n pixels of one image in another, with the affine maps of their patches."""

    first: Integers
    """(n + 1,) index of each pixel's first hypothesis."""
    places: Floats
    """(m, 2) positions in the other image [px]."""
    maps: Floats
    """(m, 2, 2) linear parts of the affine maps."""

    def __post_init__(self) -> None:
        freeze_fields(self, "first", dtype=np.int64)
        freeze_fields(self, "places", "maps")

    def only(self, kept: Mask) -> "Hypotheses":
        """Return a part of the hypotheses, given by (m,)."""
        before = np.concatenate([[0], np.cumsum(kept)])
        return Hypotheses(first=before[self.first], places=self.places[kept], maps=self.maps[kept])


def facing_maps(template: Camera, search: Camera, pixels: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Map patches into another image by planes that face both cameras.

    Args:
        template: The camera of the pixels.
        search: The other camera.
        pixels: (n, 2) centres of the patches [px].
        points: (n, ..., 3) points that the pixels may show [m].

    Returns:
        Positions (n, ..., 2) in the other image [px], and the linear parts (n, ..., 2, 2) of the affine maps.
    """
    middle = points.ndim - 2
    around = pixels[:, None] + np.array([[0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    rays = template.rays(around).directions
    rays = rays.reshape(len(pixels), *([1] * middle), 4, 3)
    first, second = (unit(camera.centre - points) for camera in (template, search))
    normal = unit(first + second)
    reach = np.sum(normal * (points - template.centre), axis=-1)[..., None] / np.einsum(
        "...kj,...j->...k", rays, normal
    )
    there = search.project(template.centre + reach[..., None] * rays)
    right, down = there[..., 0, :] - there[..., 1, :], there[..., 2, :] - there[..., 3, :]
    return search.project(points), np.stack([right, down], axis=-1)


def hypotheses(
    template: Camera, search: Camera, pixels: Floats, *, step: float, margin: float,
    settings: SurfaceSeedSettings = SURFACE_SEED_DEFAULTS,
) -> Hypotheses:  # fmt: skip
    """Generate hypotheses along epipolar lines, for all depths that the other camera sees.

    Args:
        template: The camera of the pixels.
        search: The camera in whose image they are searched.
        pixels: (n, 2) pixels in the template [px].
        step: Distance of successive hypotheses in the other image [px].
        margin: Least distance from its border [px].
        settings: Range of the depths, and number of computed ones.

    Returns:
        The hypotheses; none for a pixel whose line misses the image.
    """
    nearest = settings.nearest_baselines * float(np.linalg.norm(search.centre - template.centre))
    inverse = np.linspace(settings.farthest_ratio, 1, settings.supports) / nearest
    points = template.centre + template.rays(pixels).directions[:, None] / inverse[:, None]
    places, maps = facing_maps(template, search, pixels, points)
    seen = search.sees(places, margin=margin) & np.isfinite(maps).all(axis=(-1, -2))
    both = seen[:, 1:] & seen[:, :-1]
    length = np.where(both, np.linalg.norm(np.diff(places, axis=1), axis=-1), 0.0)
    length = np.where(np.isfinite(length), length, 0.0)
    return _resampled(places, maps, length, step)


def _resampled(places: Floats, maps: Floats, length: Floats, step: float) -> Hypotheses:
    """Sample polylines (n, k, 2) in equal steps, along the segments with a positive length (n, k - 1)."""
    total = length.sum(axis=1)
    counts = np.floor(total / step).astype(int) + (total > 0)
    row = np.repeat(np.arange(len(places)), counts)
    first = np.concatenate([[0], np.cumsum(counts)])
    along = (np.arange(first[-1]) - first[row] + 0.5) * (total / np.maximum(counts, 1))[row]
    ends = np.cumsum(length, axis=1)
    # One sorted list of all polylines, in which each begins after the end of the one before.
    shift = np.concatenate([[0], np.cumsum(total + 1)])[:-1]
    piece = np.searchsorted((ends + shift[:, None]).ravel(), along + shift[row]) - row * length.shape[1]
    piece = np.clip(piece, 0, length.shape[1] - 1)
    own = length[row, piece]
    share = np.divide(along - (ends[row, piece] - own), own, out=np.zeros(len(row)), where=own > 0)
    share = np.clip(share, 0, 1)[:, None]
    here = (1 - share) * places[row, piece] + share * places[row, piece + 1]
    turned = (1 - share[..., None]) * maps[row, piece] + share[..., None] * maps[row, piece + 1]
    return Hypotheses(first=first, places=here, maps=turned)


def correlations(template: Floats, search: Floats, pixels: Floats, tried: Hypotheses, *, half: int) -> Floats:
    """Correlate patches about pixels with the other image at each of their hypotheses.

    Args:
        template: (H, W) float32 grey image.
        search: (h, w) float32 grey image that is searched.
        pixels: (n, 2) pixels in the template [px].
        tried: Hypotheses of the pixels.
        half: Half-size of the patches [px].

    Returns:
        (m,) correlations from -1 to 1; -1 if a patch leaves an image or is flat.
    """
    scores = np.full(len(tried.places), -1.0)
    _correlate(
        template, search, np.ascontiguousarray(pixels, float), tried.first, tried.places, tried.maps.reshape(-1, 4),
        half, scores,
    )  # fmt: skip
    return scores


@kernel
def _correlate(template, search, pixels, first, places, maps, half, scores):
    side = 2 * half + 1
    size = side * side
    grey, identity = np.empty(size, np.float32), np.array([1.0, 0.0, 0.0, 1.0])
    found, offsets = np.empty(size, np.float32), np.empty((2, size))
    shares, corner = np.empty((2, size), np.float32), np.empty(size, np.int32)
    for i in range(size):
        offsets[0, i], offsets[1, i] = i % side - half, i // side - half
    for i in range(len(pixels)):
        if first[i] == first[i + 1] or not _take(template, pixels[i], identity, half, offsets, shares, corner, grey):
            continue
        for k in range(first[i], first[i + 1]):
            if _take(search, places[k], maps[k], half, offsets, shares, corner, found):
                scores[k] = _product(grey, found)


@kernel(fastmath=True)
def _product(grey, found):
    total = np.float32(0.0)
    for j in range(grey.shape[0]):
        total += grey[j] * found[j]
    return total


@kernel(fastmath=True)
def _take(picture, place, turn, half, offsets, shares, corner, out):
    """Write a linearly interpolated patch of mean 0 and norm 1; return false if it is outside or flat.

    The positions of all pixels are computed first, in a loop that the compiler vectorises.

    Args:
        picture: (H, W) float32.
        place: (2,) centre of the patch [px].
        turn: (4,) linear part of the map, row by row.
        half: half-size of the patch [px].
        offsets: (2, N) x and y of the pixels from the centre [px].
        shares: (2, N) work array, float32.
        corner: (N,) work array, int32.
        out: (N,) float32.
    """
    height, width = picture.shape
    a, b, c, d = turn
    wide, high = half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
    x0, y0 = place
    if not (x0 - wide >= 0 and y0 - high >= 0 and x0 + wide < width - 1 and y0 + high < height - 1):
        return False
    flat, size, total = picture.reshape(height * width), out.shape[0], np.float32(0.0)
    right, down = shares[0], shares[1]
    for k in range(size):
        x, y = x0 + a * offsets[0, k] + b * offsets[1, k], y0 + c * offsets[0, k] + d * offsets[1, k]
        column, row = np.int32(x), np.int32(y)
        right[k], down[k] = x - column, y - row
        corner[k] = row * width + column
    for k in range(size):
        at, s = np.uintp(corner[k]), right[k]
        below = at + np.uintp(width)
        upper = flat[at] + s * (flat[at + np.uintp(1)] - flat[at])
        lower = flat[below] + s * (flat[below + np.uintp(1)] - flat[below])
        out[k] = upper + down[k] * (lower - upper)
        total += out[k]
    total /= size
    power = np.float32(0.0)
    for k in range(size):
        out[k] -= total
        power += out[k] * out[k]
    if power < size:
        return False
    scale = np.float32(1.0) / np.sqrt(power)
    for k in range(size):
        out[k] *= scale
    return True
