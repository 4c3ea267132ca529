"""Where an image may show a ball at the body's surface: edges vote for the centre towards which they rise."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask
from marey.knee.space.bias_field import BiasField, bias_field
from marey.knee.space.resampling import on_grid, read_at, resampled, upright_grid
from marey.knee.space.volume import Volume, VoxelGrid

WORK_MM = 1.0
RADII_MM = (1.5, 11.0)
_BANDS_MM = ((1.5, 3.0), (3.0, 5.0), (5.0, 8.0), (8.0, 11.0))
_STEP_MM = 0.75
_VOTE_SIGMA_MM = 1.0
_ACROSS_MM = 1.5
_STEEP = 0.1
"""Least slope of an edge that votes [1/mm], as a share of the bright tissue's level: a third of a ball's."""
_LEAST_VOTES = 0.12
"""Least share of a sphere that has voted: votes of noisy normals miss the centre, so it is far below the true share."""
_LEAST_SHARE = 0.35
"""Least share of the directions from its centre in which a ball must end at its radius."""
_DROP = 0.4
_SMOOTHING_MM = 0.7
_BRIGHT_PERCENT = 95
_AIR_SPREADS, _AIR_SHARE = 5.0, 0.1
_AIR_BIAS = 1.4
"""Air lies so far over its peak where a scanner has evened out its coils."""
_NEAR_AIR = 0.1
"""Least share of air in the box that is twice as wide as the largest ball."""
_MOST = 80
_DIRECTIONS = 200
_ROUNDS = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class BallCandidate:
    """A place that may be a ball."""

    centre_mm: Floats
    """(3,) LPS."""
    radius_mm: float
    share: float
    """Of all directions from its centre, those in which it ends at its radius."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LimbImage:
    """An image at work: corrected, smoothed, on an upright grid of 1 mm, with the air about the limb."""

    intensity: np.ndarray
    """(k, j, i) without bias."""
    air: Mask
    """(k, j, i) what is as dark as air and hangs together with the image's sides."""
    bright: float
    """Level of the bright tissue: what nineteen of twenty voxels that are no air do not exceed."""
    known: Mask
    """(k, j, i) where the image reaches."""
    bias: BiasField
    grid: VoxelGrid


def limb_image(volume: Volume) -> LimbImage:
    """Correct an image's bias, lay it on an upright grid, and find the air about the limb in it."""
    grid = upright_grid(volume.grid, WORK_MM)
    bias = bias_field(volume)
    plain = on_grid(volume, grid, _SMOOTHING_MM)
    # A turned image leaves corners of the upright grid empty: nothing is known there, least of all air.
    known = resampled(np.ones(volume.grid.shape, dtype=np.uint8), volume.grid, grid, order=0) > 0
    # Air as the scanner gave it: taking out the bias would raise its noise here and there.
    values = plain[known]
    high = float(np.percentile(values, 99.5))
    level = max(_top_of_lowest_peak(values, high), _AIR_SHARE * _bright(values, 0.3 * high))
    dark = known & (plain < level)
    intensity = plain / bias.on(grid)
    air, bright = _from_sides(dark, known), _bright(intensity[known & ~dark], 0.0)
    return LimbImage(intensity=intensity, air=air, bright=bright, known=known, bias=bias, grid=grid)


def _bright(values: np.ndarray, over: float) -> float:
    tissue = values[values > over]
    return float(np.percentile(tissue, _BRIGHT_PERCENT)) if tissue.size else float("inf")


def _top_of_lowest_peak(values: np.ndarray, high: float) -> float:
    """Return the value that air hardly exceeds: its peak is the histogram's lowest, and only air lies below."""
    counts, edges = np.histogram(values, bins=256, range=(0.0, max(high, 1e-6)))
    smooth = ndimage.gaussian_filter1d(counts.astype(float), 1.0, mode="constant")
    peaks = (smooth >= ndimage.maximum_filter1d(smooth, 5)) & (smooth > 0.05 * smooth.max())
    peak = float(edges[int(np.argmax(peaks))] + edges[1] / 2)
    below = values[values < peak]
    spread = float(np.sqrt(((below - peak) ** 2).mean())) if below.size else 0.0
    return max(peak + _AIR_SPREADS * spread, _AIR_BIAS * peak)


def _from_sides(dark: Mask, known: Mask) -> Mask:
    """(k, j, i) the dark pieces that reach the image's right, left, front or back: marrow reaches its ends at most."""
    pieces, _ = ndimage.label(dark)
    inner = ndimage.binary_erosion(known, np.ones((1, 3, 3), dtype=bool))
    outside = np.unique(pieces[known & ~inner])
    return np.asarray(np.isin(pieces, outside[outside > 0]))


def ball_candidates(limb: LimbImage) -> list[BallCandidate]:
    """List places at the body's surface, or outside it, that are bright, round and end sharply; the likeliest first.

    As in Hough's transform for spheres every voxel on an edge votes for the places at a ball's radius along its
    gradient. What a vote weighs is the area of edge that it stands for, so that half a ball that sticks out of fat
    as bright as itself counts half, whatever its contrast. Rays from each place then tell centre and radius.

    Args:
        limb: The prepared image.
    """
    wide = int(4 * RADII_MM[1] / WORK_MM)
    near = ndimage.uniform_filter(limb.air.astype(np.float32), wide, mode="nearest") > _NEAR_AIR
    edges = _edges(limb, near)
    places: list[tuple[float, Floats]] = []
    for band in _BANDS_MM:
        share = _votes(edges, limb.grid.shape, band)
        peaks = (ndimage.maximum_filter(share, 5) == share) & (share > _LEAST_VOTES) & near
        voxels = np.argwhere(peaks)
        places += [(float(share[tuple(each)]), limb.grid.lps(each[::-1].astype(float))) for each in voxels]
    places.sort(key=lambda each: -each[0])
    found: list[BallCandidate] = []
    for _, place in places[:_MOST]:
        ball = _by_rays(limb, place)
        if ball is not None and not any(_same(ball, other) for other in found):
            found.append(ball)
    return sorted(found, key=lambda each: -each.share)


def _same(ball: BallCandidate, other: BallCandidate) -> bool:
    return bool(np.linalg.norm(ball.centre_mm - other.centre_mm) < 0.5 * min(ball.radius_mm, other.radius_mm))


def _edges(limb: LimbImage, near: Mask) -> tuple[Floats, Floats, Floats]:
    """(n, 3) voxels k, j, i on edges, (n, 3) their normals towards the bright side, (n,) the area they stand for."""
    gradient = [np.asarray(each, dtype=np.float32) for each in np.gradient(limb.intensity, WORK_MM)]
    slope = np.sqrt(sum(each**2 for each in gradient))
    steep = np.argwhere(near & (slope > _STEEP * limb.bright))
    at = tuple(steep.T)
    normals = np.stack([each[at] for each in gradient], axis=-1) / slope[at][:, None]
    across = [
        ndimage.map_coordinates(
            limb.intensity, (steep + sign * _ACROSS_MM / WORK_MM * normals).T, order=1, mode="nearest"
        )
        for sign in (-1, 1)
    ]  # fmt: skip
    height = np.maximum(across[1] - across[0], slope[at] * WORK_MM)
    return steep.astype(float), normals, slope[at] / height * WORK_MM**3


def _votes(
    edges: tuple[Floats, Floats, Floats], shape: tuple[int, int, int], band_mm: tuple[float, float]
) -> np.ndarray:
    """(k, j, i) share of a sphere of some radius of the band whose edges rise towards each place."""
    voxels, normals, areas = edges
    votes = np.zeros(int(np.prod(shape)), dtype=np.float32)
    for radius in np.arange(band_mm[0], band_mm[1] + 1e-6, _STEP_MM):
        place = np.rint(voxels + radius / WORK_MM * normals).astype(np.int64)
        inside = ((place >= 0) & (place < shape)).all(axis=1)
        index = np.ravel_multi_index(tuple(place[inside].T), shape)
        votes += np.bincount(index, areas[inside] / (4 * np.pi * radius**2), votes.size).astype(np.float32)
    sigma = _VOTE_SIGMA_MM / WORK_MM
    gathered: np.ndarray = ndimage.gaussian_filter(votes.reshape(shape), sigma, mode="constant")
    return gathered * (2 * np.pi) ** 1.5 * sigma**3 * _STEP_MM


def _by_rays(limb: LimbImage, place_mm: Floats) -> BallCandidate | None:
    """Find where rays from a place leave what is bright, and the sphere through these ends; None without one."""
    centre, rays = place_mm, sphere_directions()
    steps = np.arange(0.0, RADII_MM[1] + 3.0, 0.5)
    for _ in range(_ROUNDS):
        values = read_at(limb.intensity, limb.grid, centre + steps[None, :, None] * rays[:, None, :])
        level = float(np.median(values[:, :3]))
        falls = values[:, :-4] - values[:, 4:]
        end = np.argmax(falls > _DROP * level, axis=1)
        # The steepest place within a millimetre after the first fall that is large enough.
        window = np.minimum(end[:, None] + np.arange(3), falls.shape[1] - 1)
        best = np.take_along_axis(window, np.argmax(np.take_along_axis(falls, window, 1), axis=1)[:, None], 1)[:, 0]
        clear = falls[np.arange(len(rays)), best] > _DROP * level
        if level <= 0 or clear.mean() < _LEAST_SHARE:
            return None
        reach = steps[best] + 1.0
        radius = float(np.median(reach[clear]))
        good = clear & (np.abs(reach - radius) < 1.0 + 0.2 * radius)
        if good.mean() < 0.6 * _LEAST_SHARE:
            return None
        centre, radius = _sphere(centre + reach[good, None] * rays[good])
        if not RADII_MM[0] <= radius <= RADII_MM[1] or np.linalg.norm(centre - place_mm) > 2 * RADII_MM[1]:
            return None
    if good.mean() < _LEAST_SHARE:
        return None
    return BallCandidate(centre_mm=centre, radius_mm=radius, share=float(good.mean()))


def _sphere(points: Floats) -> tuple[Floats, float]:
    """Give centre and radius of the sphere that fits points (n, 3) best: |p|^2 = 2 c p + (r^2 - |c|^2)."""
    middle = points.mean(axis=0)
    off = points - middle
    solved = np.linalg.lstsq(np.column_stack([2 * off, np.ones(len(off))]), (off**2).sum(axis=1), rcond=None)[0]
    return middle + solved[:3], float(np.sqrt(max(solved[3] + solved[:3] @ solved[:3], 0.0)))


def sphere_directions(count: int = _DIRECTIONS) -> Floats:
    """(n, 3) unit vectors spread evenly: Fibonacci's lattice on the sphere."""
    n = np.arange(count) + 0.5
    height, turn = 1 - 2 * n / count, np.pi * (1 + 5**0.5) * n
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=-1)
