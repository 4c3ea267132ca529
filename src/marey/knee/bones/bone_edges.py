"""Evidence for a bone's edge on the image's own voxels, from how bright it is inside and outside just there."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from marey.arrays import Floats
from marey.knee.bones.marrow import Kind
from marey.knee.bones.outer_edge import at_half_level
from marey.knee.space.distances import signed_distance
from marey.knee.space.minimal_cut import minimal_cut
from marey.knee.space.resampling import smoothed
from marey.knee.space.volume import Grid

_COARSE_NATS_MM = {"dark": 1.5, "bright": 6.0}
_FINE_NATS_MM = {"dark": 1.5, "bright": 3.0}
"""Price of a bone's surface: about bright marrow only the thin black cortex keeps it from fat that looks alike."""
_OUTWARD = {"dark": 0.5, "bright": 0.3}
"""How far the edge may move outward, as a share of how far inward; of dark marrow in a small bone only."""
_MOST_NATS = 4.0
_INSIDE_MM, _OUTSIDE_MM = 4.0, 2.0
"""Widths [mm] of the Gaussians over which levels are averaged: of marrow, and of the dark line about bright marrow."""
_LEAST_STEP = 0.5
"""The least step down from bright marrow to what is about it, as a share of the usual one about the same bone."""
_CORTEX_MM = (0.4, 2.5)
_SOFT_TISSUE = (0.35, 0.75)
"""How bright muscle and cartilage are beside bright marrow, as shares of it."""
_SOFT_NATS = 1.0
_FAT_SMOOTHING_MM, _FAT_STEPS, _FAT_SHARE = 0.7, 3.0, 0.12
"""Fat counts as brighter than dark marrow when, smoothed, it is so by this many times the marrow's own unevenness, and
this share of what is next to the bone is of one level."""
_FEW_VOXELS = 200
_FAT_FROM_BRIGHT_MM, _FAT_BRIGHT = 1.0, 6.0
_BLUR_MM = 1.6
"""Width of the layer that looks like fat where cartilage is smoothed into marrow, at most."""
_FAINT_SMOOTHING_MM = 0.5


@dataclass(frozen=True, kw_only=True)
class _Ring:
    """Where the level outside a bone is taken from: how far from the edge, and averaged over what width [mm]."""

    from_mm: float
    to_mm: float
    sigma_mm: float
    band_mm: float
    """How far the edge may move."""


_COARSE_RING = _Ring(from_mm=0.7, to_mm=5.0, sigma_mm=2.0, band_mm=4.0)
_FINE_RING = _Ring(from_mm=0.4, to_mm=2.2, sigma_mm=1.2, band_mm=2.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Piece:
    """A bone's part of an image: intensities without bias, and how far its coarse edge is."""

    intensity: np.ndarray
    """(k, j, i)."""
    distance_mm: np.ndarray
    """(k, j, i) to the coarse edge, positive inside."""
    prior_nats: np.ndarray
    """(k, j, i) log odds to be inside by what else is known, a template."""
    grid: Grid
    rough: bool = True
    """Whether the coarse edge may be off by more than a voxel or two."""
    small: bool = False
    """A patella: even, and known well by growing, so that the edge need not go far outward."""
    no_signal: float | None = None
    """Level of air in the image, if there is any in view."""


def refined(piece: Piece, kind: Kind, others: list[np.ndarray] | None = None) -> np.ndarray:
    """Move a bone's edge from its coarse place to where the image changes.

    Args:
        piece: The bone's part of the image.
        kind: Whether marrow is dark or bright. The black line of the cortex about bright marrow belongs to the bone.
        others: Log odds (k, j, i) from further images of the same place.

    Returns:
        (k, j, i) signed distance [mm], positive inside, exact near the edge.
    """
    settled = piece.prior_nats + sum(others or [], np.zeros(1, dtype=np.float32))
    distance = piece.distance_mm
    if kind == "dark" or piece.rough:
        distance = _cut(piece, kind, settled, distance, _COARSE_RING)
    # Again with the levels just beside the edge, now that it is known to a voxel or two.
    distance = _cut(piece, kind, settled, distance, _FINE_RING)
    if kind == "dark":
        return _in_one(at_half_level(piece.intensity, distance, piece.grid, no_signal=piece.no_signal))
    # Beside bright marrow the edge may go outward by little at a time, lest it jumps over the black line.
    distance = _cut(piece, kind, settled, distance, _FINE_RING)
    return distance + _cortex(piece, distance)


def _cut(piece: Piece, kind: Kind, known: np.ndarray, distance: np.ndarray, ring: "_Ring") -> np.ndarray:
    odds = marrow_odds(piece, kind, distance, ring) + known
    outward = (1.0 if kind == "dark" and not piece.small else _OUTWARD[kind]) * ring.band_mm
    odds = np.where(distance > ring.band_mm, 100.0, np.where(distance < -outward, -100.0, odds))
    spacing = piece.grid.array_spacing_mm
    price = (_FINE_NATS_MM if ring is _FINE_RING else _COARSE_NATS_MM)[kind]
    inside = minimal_cut(odds.astype(np.float32), distance > 0, spacing, surface_nats_mm=price)
    return signed_distance(_main_part(inside > 0.5), spacing)


def marrow_odds(
    piece: Piece, kind: Kind, distance: np.ndarray | None = None, ring: "_Ring | None" = None
) -> np.ndarray:
    """(k, j, i) log odds of marrow against what is outside, by the level halfway between both just there."""
    distance, ring = (piece.distance_mm if distance is None else distance), ring or _COARSE_RING
    intensity, grid = piece.intensity, piece.grid
    level = _local_level(intensity, distance > 1.0, grid, _INSIDE_MM)
    deep = intensity[distance > 2.5] if (distance > 2.5).any() else intensity[distance > 0]
    noise = max(1.4826 * float(np.median(np.abs(deep - np.median(deep)))), 0.02 * abs(float(np.median(deep))))
    if kind == "dark":
        beside = (distance < -ring.from_mm) & (distance > -ring.to_mm)
        outside = _local_level(np.minimum(intensity, np.percentile(intensity[beside], 99)), beside, grid, ring.sigma_mm)
        step = np.maximum(outside - level, 2 * noise)
    else:
        share = _darkest_near(intensity, distance, grid) / np.maximum(level, 1e-6) - 1
        # Where no dark line is near, the edge lies within marrow as yet: a small step would hold it there.
        usual = float(np.median(share[np.abs(distance) < 1.0])) if (np.abs(distance) < 1.0).any() else 0.0
        step = np.minimum(np.minimum(share, _LEAST_STEP * usual) * level, -2 * noise)
    odds = _half_level_odds(intensity - level, step, noise)
    if kind == "dark" and ring is _FINE_RING:
        odds = _against_fat(piece, distance, level, noise, odds)
    return np.clip(odds, -_MOST_NATS, _MOST_NATS)


def _half_level_odds(above: np.ndarray, step: np.ndarray | float, noise: float) -> np.ndarray:
    return np.asarray(-(above - step / 2) * step / (noise**2 + (step / 4) ** 2))


def _against_fat(piece: Piece, distance: np.ndarray, level: np.ndarray, noise: float, odds: np.ndarray) -> np.ndarray:
    """(k, j, i) the odds, less where it looks like the fat next to dark marrow: a film of it before muscle is no bone.

    The level outside is that of the muscle there, and halfway to it a film of fat would be marrow.
    """
    even = smoothed(piece.intensity, piece.grid, _FAT_SMOOTHING_MM)
    fat, marrow, most = _fat_level(even[distance > 2.5], even[(distance < -1) & (distance > -6)])
    if fat is None:
        return odds
    step, middle = fat - marrow, level + (most - marrow) / 2
    like_fat = (even > most) & (even < marrow + 2 * step)
    above = piece.intensity - middle
    surely = (_far_from_bright(even, marrow + _FAT_BRIGHT * step, piece.grid) | _thick(like_fat, piece.grid)) & (
        above < 2 * step
    )
    odds = np.where(surely, np.minimum(odds, _half_level_odds(above, step, noise)), odds)
    # Elsewhere it may be the blur of what is bright, or a film too thin to tell: no evidence for marrow either.
    faint = smoothed(piece.intensity, piece.grid, _FAINT_SMOOTHING_MM) - middle
    return np.where((faint > step / 2) & (faint < 2 * step), np.minimum(odds, 0), odds)


def _far_from_bright(even: np.ndarray, bright: float, grid: Grid) -> np.ndarray:
    """(k, j, i) true where nothing bright, cartilage, is near: what is next to it looks like fat where half of it."""
    size = [2 * round(_FAT_FROM_BRIGHT_MM / each) + 1 for each in grid.array_spacing_mm]
    return np.asarray(ndimage.maximum_filter(even, size) < bright)


def _thick(like_fat: np.ndarray, grid: Grid) -> np.ndarray:
    """(k, j, i) what is like fat in layers wider than the blur of something bright, and than a voxel."""
    box = [max(2, round(_BLUR_MM / each)) for each in grid.array_spacing_mm]
    return np.asarray(ndimage.binary_opening(like_fat, np.ones(box)))


def _fat_level(deep: np.ndarray, ring: np.ndarray) -> tuple[float | None, float, float]:
    """Give the level of fat beside a bone, its marrow's, and the most of its marrow's.

    Fat is none where no level stands out of the ring, or none that is clearly brighter than marrow is uneven.
    """
    if len(deep) < _FEW_VOXELS or len(ring) < _FEW_VOXELS:
        return None, 0.0, 0.0
    marrow, most = np.percentile(deep, [50, 95])
    deviation = 1.4826 * float(np.median(np.abs(deep - marrow)))
    bins = np.arange(most, max(float(ring.max()), most + 10 * deviation), deviation / 2)
    counts = np.convolve(np.histogram(ring, bins)[0], np.ones(5), "same")
    fat = float(bins[counts.argmax()] + deviation / 4)
    share = float((np.abs(ring[ring > most] - fat) < 1.5 * deviation).mean()) if (ring > most).any() else 0.0
    clear = fat - marrow > _FAT_STEPS * (most - marrow) and share > _FAT_SHARE
    return fat if clear else None, float(marrow), float(most)


def soft_tissue_odds(piece: Piece) -> np.ndarray:
    """(k, j, i) log odds from an image with bright marrow beside one with dark: against muscle and cartilage only.

    Fat there is as bright as marrow, and cortex as black as tendon: neither says anything.
    """
    marrow = _local_level(piece.intensity, piece.distance_mm > 2.0, piece.grid, 2 * _INSIDE_MM)
    share = smoothed(piece.intensity, piece.grid, 0.5) / np.maximum(marrow, 1e-6)
    soft = (share > _SOFT_TISSUE[0]) & (share < _SOFT_TISSUE[1])
    return np.where(soft, -_SOFT_NATS, 0.0)


def _local_level(intensity: np.ndarray, mask: np.ndarray, grid: Grid, sigma_mm: float) -> np.ndarray:
    weight = smoothed(mask, grid, sigma_mm)
    return smoothed(intensity * mask, grid, sigma_mm) / np.maximum(weight, 1e-3)


def _darkest_near(intensity: np.ndarray, distance: np.ndarray, grid: Grid) -> np.ndarray:
    """(k, j, i) the dark level just outside bright marrow: cortex or cartilage, whichever is there."""
    size = [2 * max(0, int(1.5 / spacing)) + 1 for spacing in grid.array_spacing_mm]
    darkest = ndimage.minimum_filter(smoothed(intensity, grid, 0.3), size)
    return _local_level(darkest, np.abs(distance) < 2, grid, _OUTSIDE_MM)


def _main_part(mask: np.ndarray) -> np.ndarray:
    labels, count = ndimage.label(mask)
    if count > 1:
        mask = labels == 1 + int(np.bincount(labels.ravel())[1:].argmax())
    return np.asarray(ndimage.binary_fill_holes(mask))


def _in_one(distance: np.ndarray) -> np.ndarray:
    """(k, j, i) a distance without islands and hollows."""
    inside = _main_part(distance > 0)
    return np.where(inside, np.maximum(distance, 1e-3), np.minimum(distance, -1e-3))


def _cortex(piece: Piece, distance: np.ndarray) -> np.ndarray:
    """(k, j, i) how far [mm] the black line of cortex about bright marrow reaches; 0 where cartilage or nothing is.

    Where fat lies behind the line its end is seen; how far it reaches there as a rule is taken where it is not seen:
    beside muscle and tendon.
    """
    spacing = np.array(piece.grid.array_spacing_mm)
    gradient = np.stack(np.gradient(ndimage.gaussian_filter(distance, 1.0), *spacing), axis=-1)
    edge = np.argwhere((distance > 0) & (distance < max(spacing.min(), 0.5)))
    edge = edge[:: max(1, len(edge) // 20000)]
    outward = -gradient[tuple(edge.T)]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-6)
    steps = np.arange(-3.0, 4.01, 0.25)
    places = edge[:, None] + steps[None, :, None] * outward[:, None] / spacing
    profile = ndimage.map_coordinates(piece.intensity, np.moveaxis(places, -1, 0), order=1, mode="nearest")
    outer, seen, black = _line_ends(profile, steps)
    outer = outer - distance[tuple(edge.T)]
    usual = float(np.clip(np.median(outer[seen]), *_CORTEX_MM)) if seen.sum() > 50 else 0.0
    asked = np.where(seen, np.clip(outer, 0, 2 * usual), usual) * black
    tree = cKDTree(edge * spacing)
    band = np.argwhere(np.abs(distance) < 4)
    away, near = tree.query(band * spacing, k=12)
    share = 1 / (away + 1.0)
    thickness = np.zeros_like(distance)
    thickness[tuple(band.T)] = (share * asked[near]).sum(axis=1) / share.sum(axis=1)
    return thickness


def _line_ends(profile: Floats, steps: Floats) -> tuple[Floats, np.ndarray, np.ndarray]:
    """(N,) where the dark line outside the marrow ends, whether both its edges are seen, and whether it is there."""
    marrow = np.median(profile[:, steps < -1], axis=1)
    near = (steps >= -0.5) & (steps <= 1.5)
    least = profile[:, near].min(axis=1)
    half = (marrow + least) / 2
    black = least < 0.6 * marrow
    dark = profile < half[:, None]
    start = np.argmax(dark & (steps > -1.5), axis=1)
    after = dark[np.arange(len(dark))[:, None], np.minimum(start[:, None] + np.arange(len(steps)), len(steps) - 1)]
    length = np.argmin(after, axis=1)
    ends = length > 0
    step = steps[1] - steps[0]
    outer = _outer_end(profile, steps, start, length, black)
    bright = profile[np.arange(len(dark)), np.minimum(start + length + 2, len(steps) - 1)] > 0.8 * marrow
    return outer, black & ends & bright & (length * step < 3), black


def _outer_end(profile: Floats, steps: Floats, start: np.ndarray, length: np.ndarray, black: np.ndarray) -> Floats:
    """(N,) where the dark line ends: from its middle half of its width on.

    The width is what is missing from marrow, over what is missing where lines are darkest: the half level of a line
    thinner than a voxel lies too far out, its area is the same however blurred it is.
    """
    marrow = np.median(profile[:, steps < -1], axis=1)[:, None]
    near = profile[:, (steps >= -0.5) & (steps <= 1.5)].min(axis=1)
    darkest = float(np.percentile(near[black], 10)) if black.any() else 0.0
    index = np.arange(len(steps))
    line = (index >= start[:, None] - 2) & (index <= (start + length)[:, None] + 1)
    missing = np.clip((marrow - profile) / np.maximum(marrow - darkest, 1e-6), 0, 1) * line
    total = np.maximum(missing.sum(axis=1), 1e-6)
    return np.asarray((missing * steps).sum(axis=1) / total + total * (steps[1] - steps[0]) / 2)
