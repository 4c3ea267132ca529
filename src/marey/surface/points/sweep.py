"""Where on its epipolar line a pixel's surroundings are seen: every depth is tried, and patches are compared."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.cameras.camera import Camera
from marey.kernels import kernel

_SUPPORTS = 65
"""Depths at which the epipolar curve and the affine map are computed; between them they are straight."""
_NEAREST = 0.8
"""Points nearer than this many baselines are not looked for: the views differ by more than 64 degrees there."""
_FARTHEST = 1e-4
"""One over the distance of the farthest points, relative to one over that of the nearest."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Hypotheses:
    """Where n pixels of one picture may be seen in another one, and how their surroundings would look there."""

    first: Integers
    """(n + 1,) where those of each pixel begin."""
    places: Floats
    """(m, 2) [px]."""
    maps: Floats
    """(m, 2, 2) affine map of the surroundings."""

    def __post_init__(self) -> None:
        freeze_fields(self, "first", dtype=np.int64)
        freeze_fields(self, "places", "maps")


def facing_maps(template: Camera, search: Camera, pixels: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Map a pixel's surroundings into another picture by way of a plane that faces both cameras.

    Args:
        template: The camera of the pixels.
        search: The other camera.
        pixels: (n, 2) [px].
        points: (n, ..., 3) what the pixels may show [m].

    Returns:
        Places (n, ..., 2) in the other picture [px], and the affine maps' linear parts (n, ..., 2, 2).
    """
    middle = points.ndim - 2
    around = pixels[:, None] + np.array([[0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    rays = template.rays(around).directions
    rays = rays.reshape(len(pixels), *([1] * middle), 4, 3)
    first, second = (_unit(camera.centre - points) for camera in (template, search))
    normal = _unit(first + second)
    reach = np.sum(normal * (points - template.centre), axis=-1)[..., None] / np.einsum(
        "...kj,...j->...k", rays, normal
    )
    there = search.project(template.centre + reach[..., None] * rays)
    right, down = there[..., 0, :] - there[..., 1, :], there[..., 2, :] - there[..., 3, :]
    return search.project(points), np.stack([right, down], axis=-1)


def hypotheses(template: Camera, search: Camera, pixels: Floats, *, step: float, margin: float) -> Hypotheses:
    """Lay hypotheses along epipolar lines, over all depths at which the other camera sees them.

    Args:
        template: The camera of the pixels.
        search: The camera in whose picture they are looked for.
        pixels: (n, 2) [px].
        step: From one to the next in the other picture [px].
        margin: How far from its border they stay [px].

    Returns:
        The hypotheses; a pixel whose line misses the picture has none.
    """
    nearest = _NEAREST * float(np.linalg.norm(search.centre - template.centre))
    inverse = np.linspace(_FARTHEST, 1, _SUPPORTS) / nearest
    points = template.centre + template.rays(pixels).directions[:, None] / inverse[:, None]
    places, maps = facing_maps(template, search, pixels, points)
    seen = search.sees(places, margin=margin) & np.isfinite(maps).all(axis=(-1, -2))
    both = seen[:, 1:] & seen[:, :-1]
    length = np.where(both, np.linalg.norm(np.diff(places, axis=1), axis=-1), 0.0)
    length = np.where(np.isfinite(length), length, 0.0)
    return _resampled(places, maps, length, step)


def _resampled(places: Floats, maps: Floats, length: Floats, step: float) -> Hypotheses:
    """Go along polylines (n, k, 2) in equal steps, over those pieces that have a length (n, k - 1)."""
    total = length.sum(axis=1)
    counts = np.floor(total / step).astype(int) + (total > 0)
    row = np.repeat(np.arange(len(places)), counts)
    first = np.concatenate([[0], np.cumsum(counts)])
    along = (np.arange(first[-1]) - first[row] + 0.5) * (total / np.maximum(counts, 1))[row]
    ends = np.cumsum(length, axis=1)
    # One sorted list of all polylines, each beginning where the one before has ended.
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
    """Correlate the surroundings of pixels with what lies at each of their hypotheses.

    Args:
        template: (H, W) float32 grey picture.
        search: (h, w) the other one.
        pixels: (n, 2) [px].
        tried: Their hypotheses.
        half: Pixels from the centre to the edge of what is compared.

    Returns:
        (m,) from -1 to 1; -1 where a patch leaves a picture or is flat.
    """
    scores = np.full(len(tried.places), -1.0)
    _correlate(
        template, search, np.ascontiguousarray(pixels, float), tried.first, tried.places, tried.maps.reshape(-1, 4),
        half, scores,
    )  # fmt: skip
    return scores


@kernel
def _correlate(template, search, pixels, first, places, maps, half, scores):
    size = (2 * half + 1) ** 2
    grey, identity = np.empty(size, np.float32), np.array([1.0, 0.0, 0.0, 1.0])
    found = np.empty(size, np.float32)
    for i in range(len(pixels)):
        if first[i] == first[i + 1] or not _take(template, pixels[i], identity, half, grey):
            continue
        for k in range(first[i], first[i + 1]):
            if _take(search, places[k], maps[k], half, found):
                total = np.float32(0.0)
                for j in range(size):
                    total += grey[j] * found[j]
                scores[k] = total


@kernel(fastmath=True)
def _take(picture, place, turn, half, out):
    """Write a patch of mean 0 and length 1, linear between the pixels; false where there is none."""
    height, width = picture.shape
    a, b, c, d = turn
    wide, high = half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
    x0, y0 = place
    if not (x0 - wide >= 0 and y0 - high >= 0 and x0 + wide < width - 1 and y0 + high < height - 1):
        return False
    at, total = 0, np.float32(0.0)
    for i in range(-half, half + 1):
        for j in range(-half, half + 1):
            x, y = x0 + a * j + b * i, y0 + c * j + d * i
            column, row = int(x), int(y)
            s, t = np.float32(x - column), np.float32(y - row)
            above = picture[row, column] + s * (picture[row, column + 1] - picture[row, column])
            below = picture[row + 1, column] + s * (picture[row + 1, column + 1] - picture[row + 1, column])
            out[at] = above + t * (below - above)
            total += out[at]
            at += 1
    total /= at
    power = np.float32(0.0)
    for k in range(at):
        out[k] -= total
        power += out[k] * out[k]
    if power < at:
        return False
    scale = np.float32(1.0) / np.sqrt(power)
    for k in range(at):
        out[k] *= scale
    return True


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
