"""Bones with bright marrow cut along the dark line about them, which alone parts them from fat that is as bright."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Mask
from marey.knee.space.distances import distance_within
from marey.knee.space.minimal_cut import minimal_cut
from marey.knee.space.resampling import smoothed
from marey.knee.space.volume import Grid

_PRICE_NATS_MM, _LEAST_PRICE = 4.0, 0.1
"""Price of a bone's surface through what is even, and the share of it that is paid in the middle of a dark line."""
_LINE_MM, _LINE_SHARE, _LINE_FROM = 4.0, 0.12, 0.03
"""Lines narrower than this are seen; by so much of marrow's level must they be darker to cost 1/e of the price."""
_EVEN_MM, _SLOPE_MM = 0.24, 0.7
"""Smoothing before lines are sought, and over what length a slope counts as much as a line that is so much darker."""
_HALF, _DARK_NATS, _BRIGHT_NATS = 0.7, 3.0, 0.8
"""Where marrow is as likely as not, as a share of its level; what is said at most by darker, and by brighter voxels."""
_TOO_BRIGHT, _TOO_BRIGHT_NATS = 1.35, 5.0
_INSIDE_NATS_PER_MM, _INSIDE_FROM_MM, _INSIDE_NATS = 0.8, 1.5, 3.5
_OUTSIDE_NATS_PER_MM, _OUTSIDE_NATS = 0.5, 4.0
"""What a template's bone says: by the distance from its edge."""
_LEVEL_MM, _FAR = 8.0, 1e-3
"""Width of the Gaussian over which marrow's level is averaged, and how little of it counts as nothing known nearby."""
_TREND_MM, _TREND_RIDGE, _TREND_BEYOND, _FIT_VOXELS = 50.0, 1e-3, 0.4, 20000
"""Unit of places in the trend, its damping, and how far [natural logarithm] it may go beyond what was seen."""
_INNER_MM, _CORE_MM, _ASTRAY_MM = 2.0, 2.5, 3.0
"""How deep marrow's level is taken, how deep what is known stays, and how far beyond a template nothing is known."""
_LEANING = 0.3
"""By how much a shaft may lean or widen beyond where the template ends [mm per mm]."""
_STEP_MM = 10.0
"""How far a bone may go on in one cut."""
_NECK_MM, _THREAD_MM, _REGROWN_MM = 4.0, 1.0, 0.7
"""Radii of the balls that must pass where a bone goes on, and where it holds together; what is given back beyond."""
_MOST_ADDED, _LEAST_ADDED, _RIM_MM = 1 / 3, 0.04, 2.0
"""As shares of the bone: more is a leak, less beyond such a rim is nothing new."""
_ITERATIONS = 250


@dataclass(frozen=True, eq=False, kw_only=True)
class BrightImage:
    """A part of an image with bright marrow."""

    intensity: np.ndarray
    """(k, j, i) without bias."""
    free: Mask
    """(k, j, i) where the bone may be: in the body, and not in another bone."""
    grid: Grid


def followed(image: BrightImage, grown: Mask) -> Mask | None:
    """Go on with a bone as it grew from its seed, to where marrow is dimmer than there.

    Twice: each time marrow's level is taken from the bone as known so far. A bone is soon full, a leak widens: None
    when the second time adds more than the first did, or both of them a third of the bone; and when little is added
    beyond a rim of what had grown, which is the line's blur.

    Args:
        image: About the bone, wide enough for it to go on.
        grown: (k, j, i).
    """
    first = _through_wide_necks(cut_along_line(image, grown), image.grid)
    away = distance_within(~grown, image.grid.array_spacing_mm)
    size, more = int(grown.sum()), int((first & ~grown).sum())
    if (first & (away > _RIM_MM)).sum() < _LEAST_ADDED * size or more > _MOST_ADDED * size:
        return None
    second = _through_wide_necks(cut_along_line(image, first), image.grid)
    leaks = second.sum() - first.sum() > more or second.sum() - size > _MOST_ADDED * size
    return None if leaks else second


def cut_along_line(image: BrightImage, mask: Mask, limit_mm: np.ndarray | None = None) -> Mask:
    """Cut a bone out where it costs least: along dark lines, within what is as bright as its marrow, and not far off.

    Args:
        image: About the bone.
        mask: (k, j, i) the bone as known so far; what lies deep in it stays.
        limit_mm: (k, j, i) signed distance to a template's edge, positive inside, NaN where it says nothing.

    Returns:
        (k, j, i) one piece without holes, up to the line's inner side.
    """
    spacing = image.grid.array_spacing_mm
    share = evened(image.intensity, mask, image.grid)
    odds = _odds(share)
    if limit_mm is not None:
        odds += template_odds(limit_mm)
        mask = mask & ~(limit_mm < -_ASTRAY_MM)
    away = distance_within(~mask, spacing)
    core = distance_within(mask, spacing) > _CORE_MM
    core = _largest(core if limit_mm is None else core & ~(limit_mm < 0))
    odds = np.where(core, 100, np.where((away > _STEP_MM) | ~image.free, -100, odds))
    price = _PRICE_NATS_MM * evenness(share, image.grid)
    inside = minimal_cut(odds, mask, spacing, surface_nats_mm=price, iterations=_ITERATIONS)
    # What hangs on it by a thread, in the last slice of an image for one, is not of it.
    return np.asarray(ndimage.binary_fill_holes(_through_wide_necks(inside > 0.5, image.grid, _THREAD_MM)))


def evened(intensity: np.ndarray, mask: Mask, grid: Grid) -> np.ndarray:
    """(k, j, i) an image as shares of marrow's level there: a trend through a bone, corrected by how it is nearby.

    Args:
        intensity: (k, j, i), marrow bright.
        mask: (k, j, i) the bone as far as it is known.
        grid: Of both.
    """
    inner = distance_within(mask, grid.array_spacing_mm) > _INNER_MM
    inner = inner if inner.any() else mask
    share = intensity / _trend(intensity, inner, grid)
    nearby = (smoothed(share * inner, grid, _LEVEL_MM) + _FAR) / (smoothed(inner, grid, _LEVEL_MM) + _FAR)
    return np.asarray(share / nearby)


def _trend(intensity: np.ndarray, inner: Mask, grid: Grid) -> np.ndarray:
    """(k, j, i) exp of the polynomial of second order that fits the logarithm of marrow best, outliers left out.

    So falls the sensitivity of a coil; beyond known marrow it goes on, but not far beyond what was seen.
    """
    places = np.argwhere(inner)
    places = places[:: max(1, len(places) // _FIT_VOXELS)]
    logarithm = np.log(np.maximum(intensity[tuple(places.T)], 1e-3))
    spacing = np.array(grid.array_spacing_mm)
    middle = places.mean(axis=0)
    basis = _second_order((places - middle) * spacing / _TREND_MM)
    ridge = _TREND_RIDGE * len(places) * np.diag([0.0] + [1.0] * (basis.shape[1] - 1))
    weight = np.ones(len(places))
    for _ in range(3):
        weighted = basis * weight[:, None]
        coefficients = np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ logarithm)
        off = logarithm - basis @ coefficients
        weight = (np.abs(off) < 2.5 * 1.4826 * np.median(np.abs(off)) + 1e-6).astype(float)
    fitted = basis @ coefficients
    axes = [(np.arange(n) - m) * s / _TREND_MM for n, m, s in zip(grid.shape, middle, spacing, strict=True)]
    trend = _second_order(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)) @ coefficients
    low, high = np.percentile(fitted, [2, 98])
    return np.asarray(np.exp(np.clip(trend, low - _TREND_BEYOND, high + _TREND_BEYOND)), dtype=np.float32)


def _second_order(places: np.ndarray) -> np.ndarray:
    """(..., 10) the products of up to two coordinates of places (..., 3)."""
    z, y, x = np.moveaxis(places, -1, 0)
    return np.stack([np.ones_like(z), z, y, x, z * z, y * y, x * x, z * y, y * x, x * z], axis=-1)


def _odds(share: np.ndarray) -> np.ndarray:
    """(k, j, i) what brightness says: dark is not marrow; bright may be, but so may fat; too bright is not."""
    odds = np.clip((share - _HALF) * _DARK_NATS / (1 - _HALF), -_DARK_NATS, _BRIGHT_NATS)
    return np.asarray(np.where(share > _TOO_BRIGHT, np.minimum(odds, (_TOO_BRIGHT - share) * _TOO_BRIGHT_NATS), odds))


def template_odds(limit_mm: np.ndarray) -> np.ndarray:
    """(k, j, i) log odds to be inside by the signed distance to a template's edge; 0 where it says nothing (NaN)."""
    limit = np.nan_to_num(limit_mm, nan=0.0)
    inside = np.clip((limit - _INSIDE_FROM_MM) * _INSIDE_NATS_PER_MM, 0, _INSIDE_NATS)
    return np.asarray(np.where(limit < 0, np.maximum(limit * _OUTSIDE_NATS_PER_MM, -_OUTSIDE_NATS), inside))


def goes_on(limit_mm: np.ndarray, step_mm: float) -> np.ndarray:
    """(k, j, i) a template's limit that goes on above and below its ends (NaN), the less strictly the farther off.

    There it keeps fat out, but says of nothing that it is bone.

    Args:
        limit_mm: (k, j, i) signed distance to the template's edge, k along the shaft.
        step_mm: Between k.
    """
    heights = np.arange(len(limit_mm))[:, None, None]
    known = ~np.isnan(limit_mm)
    below = np.maximum.accumulate(np.where(known, heights, -1), axis=0)
    above = np.minimum.accumulate(np.where(known, heights, len(limit_mm))[::-1], axis=0)[::-1]
    nearest = np.where(below >= 0, below, above)
    filled = np.take_along_axis(limit_mm, np.minimum(nearest, len(limit_mm) - 1), axis=0)
    farther = filled + _LEANING * step_mm * np.abs(heights - nearest)
    return np.where(known, limit_mm, np.minimum(farther, 0)).astype(np.float32)


def evenness(share: np.ndarray, grid: Grid) -> np.ndarray:
    """(k, j, i) 1 where brightness is even, little in a dark line and where brightness changes within a slice.

    Args:
        share: (k, j, i) an image as shares of marrow's level.
        grid: Its own.
    """
    spacing = grid.array_spacing_mm
    even = smoothed(share, grid, _EVEN_MM)
    # Across thick slices a line is not seen: closing and differences look along the others' axes only.
    line = ndimage.grey_closing(even, size=[2 * int(_LINE_MM / 2 / each) + 1 for each in spacing]) - even
    slopes = [np.gradient(even, axis=axis) / max(each, 1.0) for axis, each in enumerate(spacing)]
    edge = np.maximum(line, _SLOPE_MM * np.sqrt(sum(slope**2 for slope in slopes)))
    return np.asarray(np.maximum(np.exp(-np.maximum(edge - _LINE_FROM, 0) / _LINE_SHARE), _LEAST_PRICE))


def _through_wide_necks(mask: Mask, grid: Grid, neck_mm: float = _NECK_MM) -> Mask:
    """(k, j, i) what hangs together with the largest part through necks through which a ball fits."""
    spacing = grid.array_spacing_mm
    depth = distance_within(np.pad(mask, 1, mode="edge"), spacing)[1:-1, 1:-1, 1:-1]
    main = _largest(depth > neck_mm)
    return np.asarray(mask & (distance_within(~main, spacing) <= neck_mm + _REGROWN_MM))


def _largest(mask: Mask) -> Mask:
    pieces, count = ndimage.label(mask)
    return mask if count < 2 else np.asarray(pieces == 1 + int(np.bincount(pieces.ravel())[1:].argmax()))
