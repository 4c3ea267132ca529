"""Bones with bright marrow, cut along the dark line of cortex that alone separates them from equally bright fat."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Mask
from marey.knee.space.distances import distance_within
from marey.knee.space.minimal_cut import minimal_cut
from marey.knee.space.resampling import smoothed
from marey.knee.space.volume import VoxelGrid


@dataclass(frozen=True, kw_only=True)
class BrightMarrowSettings:
    """Settings for cutting bones with bright marrow along the dark line of cortex.

    Values without a stated source were chosen by hand.
    """

    price_nats_mm: float = 4.0
    """Price [nats per mm, for a voxel of 1 mm] of a bone's surface through even brightness."""
    least_price: float = 0.1
    """Share of that price that remains in the middle of a dark line."""
    line_mm: float = 4.0
    """Largest width [mm] of a dark line."""
    line_share: float = 0.12
    """Depth of a line, as a share of marrow's level, at which the price falls to 1/e."""
    line_from: float = 0.03
    """Depth of a line, as a share of marrow's level, below which the price does not fall."""
    line_smoothing_mm: float = 0.24
    """Standard deviation [mm] of the smoothing before lines are searched."""
    slope_mm: float = 0.7
    """Length [mm] over which a slope of brightness counts like a line of the same depth."""
    even_odds_share: float = 0.7
    """Brightness, as a share of marrow's level, at which marrow and other tissue are equally likely."""
    dark_nats: float = 3.0
    """Largest log odds against marrow from dark voxels."""
    bright_nats: float = 0.8
    """Largest log odds for marrow from bright voxels: fat is as bright."""
    too_bright: float = 1.35
    """Brightness, as a share of marrow's level, above which voxels are unlikely to be marrow."""
    too_bright_nats: float = 5.0
    """Log odds against marrow per share of its level above that brightness."""
    inside_nats_per_mm: float = 0.8
    """Log odds for bone per mm of depth inside a template's edge."""
    inside_from_mm: float = 1.5
    """Depth [mm] at which these begin."""
    inside_nats: float = 3.5
    """Their largest value."""
    outside_nats_per_mm: float = 0.5
    """Log odds against bone per mm outside a template's edge."""
    outside_nats: float = 4.0
    """Their largest value."""
    level_mm: float = 8.0
    """Standard deviation [mm] of the Gaussian over which marrow's level is averaged."""
    level_floor: float = 1e-3
    """Weight added to that average: where less marrow is known nearby, the level of the trend is used."""
    trend_unit_mm: float = 50.0
    """Unit [mm] of positions in the polynomial trend of marrow's level."""
    trend_ridge: float = 1e-3
    """Ridge regularisation of the trend, per voxel."""
    trend_beyond: float = 0.4
    """Largest distance [natural logarithm] of the trend beyond the range of the known marrow."""
    trend_voxels: int = 20000
    """Number of voxels to which the trend is fitted, approximately."""
    inner_mm: float = 2.0
    """Depth [mm] in the bone from which marrow's level is measured."""
    core_mm: float = 2.5
    """Depth [mm] from which the known bone is kept."""
    astray_mm: float = 3.0
    """Distance [mm] outside a template's edge beyond which nothing of the known bone is kept."""
    leaning: float = 0.3
    """Largest lean or widening [mm per mm] of a shaft beyond the template's end."""
    step_mm: float = 10.0
    """Largest distance [mm] by which a bone grows in one cut."""
    neck_mm: float = 4.0
    """Radius [mm] of the ball that must pass where a bone is extended."""
    thread_mm: float = 1.0
    """Radius [mm] of the ball that must pass within a bone."""
    regrown_mm: float = 0.7
    """Distance [mm] beyond these radii by which a piece is grown again."""
    most_added: float = 1 / 3
    """Share of the bone beyond which an extension counts as a leak."""
    least_added: float = 0.04
    """Share of the bone below which an extension is ignored."""
    rim_mm: float = 2.0
    """Width [mm] of the rim about the bone that does not count as an extension: the blur of the line."""
    iterations: int = 250
    """Iterations of the minimal cut."""


BRIGHT_MARROW_DEFAULTS = BrightMarrowSettings()
"""Default settings for cutting bones with bright marrow along the dark line of cortex."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BrightImage:
    """A part of an image with bright marrow."""

    intensity: np.ndarray
    """(k, j, i) without bias."""
    free: Mask
    """(k, j, i) true where the bone may be: in the body, and not in another bone."""
    grid: VoxelGrid


def extended_bone(
    image: BrightImage, grown: Mask, *, settings: BrightMarrowSettings = BRIGHT_MARROW_DEFAULTS
) -> Mask | None:
    """Extend a bone that grew from its seed to where marrow is dimmer than at the seed.

    The bone is extended twice, each time with the level of marrow in the bone known so far. A leak grows from the first
    extension to the second, a bone does not.

    Args:
        image: About the bone, wide enough for the extension.
        grown: (k, j, i) the bone.
        settings: Tuned constants of the algorithm.

    Returns:
        (k, j, i) the extended bone. None where the second extension adds more than the first, or both add a third of
        the bone, and where little is added beyond a rim of the bone, which is the blur of the line.
    """
    first = _extended_once(image, grown, settings=settings)
    away = distance_within(~grown, image.grid.array_spacing_mm)
    size, more = int(grown.sum()), int((first & ~grown).sum())
    if (first & (away > settings.rim_mm)).sum() < settings.least_added * size or more > settings.most_added * size:
        return None
    second = _extended_once(image, first, settings=settings)
    leaks = second.sum() - first.sum() > more or second.sum() - size > settings.most_added * size
    return None if leaks else second


def _extended_once(image: BrightImage, mask: Mask, *, settings: BrightMarrowSettings) -> Mask:
    """(k, j, i) a bone cut anew with its level of marrow, without what lies beyond narrow necks."""
    further = cut_along_line(image, mask, settings=settings)
    return _through_wide_necks(further, image.grid, settings=settings)


def cut_along_line(
    image: BrightImage,
    mask: Mask,
    limit_mm: np.ndarray | None = None,
    *,
    settings: BrightMarrowSettings = BRIGHT_MARROW_DEFAULTS,
) -> Mask:
    """Segment a bone by a minimal cut along dark lines, in voxels as bright as its marrow, near the known bone.

    Args:
        image: About the bone.
        mask: (k, j, i) the bone known so far; its core is kept.
        limit_mm: (k, j, i) signed distance to a template's edge, positive inside, NaN where it is not known.
        settings: Tuned constants of the algorithm.

    Returns:
        (k, j, i) one piece without holes, up to the inner side of the dark line.
    """
    spacing = image.grid.array_spacing_mm
    share = evened(image.intensity, mask, image.grid, settings=settings)
    price = settings.price_nats_mm * evenness(share, image.grid, settings=settings)
    if limit_mm is not None:
        mask = mask & ~(limit_mm < -settings.astray_mm)
    away = distance_within(~mask, spacing)
    core = distance_within(mask, spacing) > settings.core_mm
    core = _largest(core if limit_mm is None else core & ~(limit_mm < 0))
    odds = _odds(share, settings=settings)
    if limit_mm is not None:
        odds += template_odds(limit_mm, settings=settings)
    odds = np.where(core, 100, np.where((away > settings.step_mm) | ~image.free, -100, odds))
    inside = minimal_cut(odds, mask, spacing, surface_nats_mm=price, iterations=settings.iterations)
    # Parts connected by a thread, for example in the last slice of an image, are removed.
    whole = _through_wide_necks(inside > 0.5, image.grid, settings.thread_mm, settings=settings)
    return np.asarray(ndimage.binary_fill_holes(whole))


def evened(
    intensity: np.ndarray, mask: Mask, grid: VoxelGrid, *, settings: BrightMarrowSettings = BRIGHT_MARROW_DEFAULTS
) -> np.ndarray:
    """Return an image as shares of the local level of marrow: a trend through a bone, corrected by a local average.

    Args:
        intensity: (k, j, i) with bright marrow.
        mask: (k, j, i) the bone known so far.
        grid: Of both.
        settings: Tuned constants of the algorithm.
    """
    inner = distance_within(mask, grid.array_spacing_mm) > settings.inner_mm
    inner = inner if inner.any() else mask
    share = intensity / _trend(intensity, inner, grid, settings=settings)
    nearby = (smoothed(share * inner, grid, settings.level_mm) + settings.level_floor) / (
        smoothed(inner, grid, settings.level_mm) + settings.level_floor
    )
    return np.asarray(share / nearby)


def _trend(intensity: np.ndarray, inner: Mask, grid: VoxelGrid, *, settings: BrightMarrowSettings) -> np.ndarray:
    """(k, j, i) exp of the second-order polynomial that fits the logarithm of marrow best, without outliers.

    It models the sensitivity of a coil, and is limited beyond the range of the known marrow.
    """
    places = np.argwhere(inner)
    places = places[:: max(1, len(places) // settings.trend_voxels)]
    logarithm = np.log(np.maximum(intensity[tuple(places.T)], 1e-3))
    spacing = np.array(grid.array_spacing_mm)
    middle = places.mean(axis=0)
    basis = _second_order((places - middle) * spacing / settings.trend_unit_mm)
    ridge = settings.trend_ridge * len(places) * np.diag([0.0] + [1.0] * (basis.shape[1] - 1))
    weight = np.ones(len(places))
    for _ in range(3):
        weighted = basis * weight[:, None]
        coefficients = np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ logarithm)
        off = logarithm - basis @ coefficients
        weight = (np.abs(off) < 2.5 * 1.4826 * np.median(np.abs(off)) + 1e-6).astype(float)
    fitted = basis @ coefficients
    axes = [
        (np.arange(n) - m) * s / settings.trend_unit_mm for n, m, s in zip(grid.shape, middle, spacing, strict=True)
    ]
    trend = _second_order(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)) @ coefficients
    low, high = np.percentile(fitted, [2, 98])
    return np.asarray(
        np.exp(np.clip(trend, low - settings.trend_beyond, high + settings.trend_beyond)), dtype=np.float32
    )


def _second_order(places: np.ndarray) -> np.ndarray:
    """(..., 10) the products of up to two coordinates of places (..., 3)."""
    z, y, x = np.moveaxis(places, -1, 0)
    return np.stack([np.ones_like(z), z, y, x, z * z, y * y, x * x, z * y, y * x, x * z], axis=-1)


def _odds(share: np.ndarray, *, settings: BrightMarrowSettings) -> np.ndarray:
    """(k, j, i) log odds of marrow by brightness: dark is not marrow; bright may be fat; too bright is neither."""
    odds = np.clip(
        (share - settings.even_odds_share) * settings.dark_nats / (1 - settings.even_odds_share),
        -settings.dark_nats,
        settings.bright_nats,
    )
    return np.asarray(
        np.where(
            share > settings.too_bright,
            np.minimum(odds, (settings.too_bright - share) * settings.too_bright_nats),
            odds,
        )
    )


def template_odds(limit_mm: np.ndarray, *, settings: BrightMarrowSettings = BRIGHT_MARROW_DEFAULTS) -> np.ndarray:
    """(k, j, i) log odds of bone by the signed distance to a template's edge; 0 where it is not known (NaN)."""
    limit = np.nan_to_num(limit_mm, nan=0.0)
    inside = np.clip((limit - settings.inside_from_mm) * settings.inside_nats_per_mm, 0, settings.inside_nats)
    return np.asarray(
        np.where(limit < 0, np.maximum(limit * settings.outside_nats_per_mm, -settings.outside_nats), inside)
    )


def continued_limit(
    limit_mm: np.ndarray, step_mm: float, *, settings: BrightMarrowSettings = BRIGHT_MARROW_DEFAULTS
) -> np.ndarray:
    """Continue a template's limit above and below its ends (NaN), and widen it with the distance from them.

    There the limit excludes fat, but does not favour bone.

    Args:
        limit_mm: (k, j, i) signed distance to the template's edge, k along the shaft.
        step_mm: Spacing of the voxels along k.
        settings: Tuned constants of the algorithm.
    """
    heights = np.arange(len(limit_mm))[:, None, None]
    known = ~np.isnan(limit_mm)
    below = np.maximum.accumulate(np.where(known, heights, -1), axis=0)
    above = np.minimum.accumulate(np.where(known, heights, len(limit_mm))[::-1], axis=0)[::-1]
    nearest = np.where(below >= 0, below, above)
    filled = np.take_along_axis(limit_mm, np.minimum(nearest, len(limit_mm) - 1), axis=0)
    farther = filled + settings.leaning * step_mm * np.abs(heights - nearest)
    return np.where(known, limit_mm, np.minimum(farther, 0)).astype(np.float32)


def evenness(
    share: np.ndarray, grid: VoxelGrid, *, settings: BrightMarrowSettings = BRIGHT_MARROW_DEFAULTS
) -> np.ndarray:
    """Return 1 where brightness is even, and less in dark lines and where brightness changes within a slice.

    Args:
        share: (k, j, i) an image as shares of marrow's level.
        grid: Of both.
        settings: Tuned constants of the algorithm.
    """
    spacing = grid.array_spacing_mm
    even = smoothed(share, grid, settings.line_smoothing_mm)
    # A line is not visible across thick slices: closing and differences use the other axes only.
    line = ndimage.grey_closing(even, size=[2 * int(settings.line_mm / 2 / each) + 1 for each in spacing]) - even
    slopes = [np.gradient(even, axis=axis) / max(each, 1.0) for axis, each in enumerate(spacing)]
    edge = np.maximum(line, settings.slope_mm * np.sqrt(sum(slope**2 for slope in slopes)))
    return np.asarray(
        np.maximum(np.exp(-np.maximum(edge - settings.line_from, 0) / settings.line_share), settings.least_price)
    )


def _through_wide_necks(
    mask: Mask, grid: VoxelGrid, neck_mm: float | None = None, *, settings: BrightMarrowSettings
) -> Mask:
    """(k, j, i) what is connected to the largest part through necks that a ball can pass."""
    neck_mm = settings.neck_mm if neck_mm is None else neck_mm
    spacing = grid.array_spacing_mm
    depth = distance_within(np.pad(mask, 1, mode="edge"), spacing)[1:-1, 1:-1, 1:-1]
    main = _largest(depth > neck_mm)
    return np.asarray(mask & (distance_within(~main, spacing) <= neck_mm + settings.regrown_mm))


def _largest(mask: Mask) -> Mask:
    pieces, count = ndimage.label(mask)
    return mask if count < 2 else np.asarray(pieces == 1 + int(np.bincount(pieces.ravel())[1:].argmax()))
