"""Candidates of balls at the body's surface: edges vote for the centre towards which brightness increases."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask
from marey.knee.space.bias_field import BiasField, bias_field
from marey.knee.space.resampling import on_grid, read_at, resampled, upright_grid
from marey.knee.space.volume import Volume, VoxelGrid

WORK_MM = 1.0
"""Spacing [mm] of the upright grid on which candidates are searched; chosen by hand."""
_DIRECTIONS = 200
"""Number of directions of the rays from a centre; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class BallCandidateSettings:
    """Settings for finding candidates of gadolinium balls.

    Values without a stated source were chosen by hand.
    """

    radii_mm: tuple[float, float] = (1.5, 11.0)
    """Least and largest radius [mm] of a candidate."""
    bands_mm: tuple[tuple[float, float], ...] = ((1.5, 3.0), (3.0, 5.0), (5.0, 8.0), (8.0, 11.0))
    """Ranges of radii [mm] whose votes are counted together."""
    radius_step_mm: float = 0.75
    """Spacing [mm] of the radii at which edges vote."""
    vote_sigma_mm: float = 1.0
    """Standard deviation [mm] of the smoothing of votes."""
    across_mm: float = 1.5
    """Distance [mm] on either side of an edge at which its height is measured."""
    least_slope: float = 0.1
    """Least slope of an edge that votes [1/mm], as a share of the level of bright tissue: a third of a ball's."""
    least_votes: float = 0.12
    """Least share of a sphere that has voted. It is far below the true share, because votes of noisy normals miss
    the centre."""
    least_share: float = 0.35
    """Least share of the directions from its centre in which a ball ends at its radius."""
    least_drop: float = 0.4
    """Least decrease of brightness at the end of a ball, as a share of its level."""
    smoothing_mm: float = 0.7
    """Standard deviation [mm] of the smoothing before the image is resampled."""
    bright_percentile: float = 95
    """Percentile of the tissue that is the level of bright tissue."""
    air_deviations: float = 5.0
    """Air ends at this many standard deviations above its peak in the histogram,"""
    air_share: float = 0.1
    """or at this share of the level of bright tissue,"""
    air_ratio: float = 1.4
    """or at this multiple of its peak, whichever is largest: scanners that even out their coils amplify air."""
    least_air: float = 0.1
    """Least share of air in the box of twice the width of the largest ball."""
    most_candidates: int = 80
    """Largest number of candidates that are examined."""
    rounds: int = 4
    """Number of rounds in which centre and radius are measured by rays."""


BALL_CANDIDATE_DEFAULTS = BallCandidateSettings()
"""Default settings for finding candidates of gadolinium balls."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BallCandidate:
    """A position that may be a ball."""

    centre_mm: Floats
    """(3,) LPS."""
    radius_mm: float
    share: float
    """Share of the directions from its centre in which it ends at its radius."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LimbImage:
    """An image without bias, smoothed, on an upright grid of 1 mm, with the air about the limb."""

    intensity: np.ndarray
    """(k, j, i) without bias."""
    air: Mask
    """(k, j, i) true in voxels as dark as air that are connected to the image's sides."""
    bright: float
    """Level of the bright tissue: 95th percentile of the voxels that are not air."""
    known: Mask
    """(k, j, i) true within the image."""
    bias: BiasField
    grid: VoxelGrid


def limb_image(volume: Volume, *, settings: BallCandidateSettings = BALL_CANDIDATE_DEFAULTS) -> LimbImage:
    """Correct an image's bias, resample it to an upright grid, and find the air about the limb."""
    grid = upright_grid(volume.grid, WORK_MM)
    bias = bias_field(volume)
    plain = on_grid(volume, grid, settings.smoothing_mm)
    # A rotated image does not reach the corners of the upright grid, which are unknown, not air.
    known = resampled(np.ones(volume.grid.shape, dtype=np.uint8), volume.grid, grid, order=0) > 0
    # Air is measured before the correction of the bias, which would amplify its noise in places.
    values = plain[known]
    high = float(np.percentile(values, 99.5))
    level = max(
        _top_of_lowest_peak(values, high, settings=settings),
        settings.air_share * _bright(values, 0.3 * high, settings=settings),
    )
    dark = known & (plain < level)
    intensity = plain / bias.on(grid)
    air, bright = _from_sides(dark, known), _bright(intensity[known & ~dark], 0.0, settings=settings)
    return LimbImage(intensity=intensity, air=air, bright=bright, known=known, bias=bias, grid=grid)


def _bright(values: np.ndarray, over: float, *, settings: BallCandidateSettings) -> float:
    tissue = values[values > over]
    return float(np.percentile(tissue, settings.bright_percentile)) if tissue.size else float("inf")


def _top_of_lowest_peak(values: np.ndarray, high: float, *, settings: BallCandidateSettings) -> float:
    """Return the upper limit of air, whose peak is the lowest of the histogram, with only air below it."""
    counts, edges = np.histogram(values, bins=256, range=(0.0, max(high, 1e-6)))
    smooth = ndimage.gaussian_filter1d(counts.astype(float), 1.0, mode="constant")
    peaks = (smooth >= ndimage.maximum_filter1d(smooth, 5)) & (smooth > 0.05 * smooth.max())
    peak = float(edges[int(np.argmax(peaks))] + edges[1] / 2)
    below = values[values < peak]
    spread = float(np.sqrt(((below - peak) ** 2).mean())) if below.size else 0.0
    return max(peak + settings.air_deviations * spread, settings.air_ratio * peak)


def _from_sides(dark: Mask, known: Mask) -> Mask:
    """(k, j, i) the dark pieces that reach the image's right, left, front or back; marrow reaches only its ends."""
    pieces, _ = ndimage.label(dark)
    inner = ndimage.binary_erosion(known, np.ones((1, 3, 3), dtype=bool))
    outside = np.unique(pieces[known & ~inner])
    return np.asarray(np.isin(pieces, outside[outside > 0]))


def ball_candidates(
    limb: LimbImage, *, settings: BallCandidateSettings = BALL_CANDIDATE_DEFAULTS
) -> list[BallCandidate]:
    """Return bright, round positions with sharp edges at the body's surface or outside it, the likeliest first.

    As in Hough's transform for spheres every voxel on an edge votes for the positions at a ball's radius along its
    gradient. The weight of a vote is the area of the edge that it represents, so that half a ball that protrudes from
    fat of the same brightness counts half, whatever its contrast. Rays from each position then measure centre and
    radius.

    Args:
        limb: The prepared image.
        settings: Tuned constants of the algorithm.
    """
    wide = int(4 * settings.radii_mm[1] / WORK_MM)
    near = ndimage.uniform_filter(limb.air.astype(np.float32), wide, mode="nearest") > settings.least_air
    edges = _edges(limb, near, settings=settings)
    places: list[tuple[float, Floats]] = []
    for band in settings.bands_mm:
        share = _votes(edges, limb.grid.shape, band, settings=settings)
        peaks = (ndimage.maximum_filter(share, 5) == share) & (share > settings.least_votes) & near
        voxels = np.argwhere(peaks)
        places += [(float(share[tuple(each)]), limb.grid.lps(each[::-1].astype(float))) for each in voxels]
    places.sort(key=lambda each: -each[0])
    found: list[BallCandidate] = []
    for _, place in places[: settings.most_candidates]:
        ball = _by_rays(limb, place, settings=settings)
        if ball is not None and not any(_same(ball, other) for other in found):
            found.append(ball)
    return sorted(found, key=lambda each: -each.share)


def _same(ball: BallCandidate, other: BallCandidate) -> bool:
    return bool(np.linalg.norm(ball.centre_mm - other.centre_mm) < 0.5 * min(ball.radius_mm, other.radius_mm))


def _edges(limb: LimbImage, near: Mask, *, settings: BallCandidateSettings) -> tuple[Floats, Floats, Floats]:
    """Return the voxels (n, 3) k, j, i on edges, their normals (n, 3) towards the bright side, and their areas (n,)."""
    gradient = [np.asarray(each, dtype=np.float32) for each in np.gradient(limb.intensity, WORK_MM)]
    slope = np.sqrt(sum(each**2 for each in gradient))
    steep = np.argwhere(near & (slope > settings.least_slope * limb.bright))
    at = tuple(steep.T)
    normals = np.stack([each[at] for each in gradient], axis=-1) / slope[at][:, None]
    across = [
        ndimage.map_coordinates(
            limb.intensity, (steep + sign * settings.across_mm / WORK_MM * normals).T, order=1, mode="nearest"
        )
        for sign in (-1, 1)
    ]  # fmt: skip
    height = np.maximum(across[1] - across[0], slope[at] * WORK_MM)
    return steep.astype(float), normals, slope[at] / height * WORK_MM**3


def _votes(
    edges: tuple[Floats, Floats, Floats],
    shape: tuple[int, int, int],
    band_mm: tuple[float, float],
    *,
    settings: BallCandidateSettings,
) -> np.ndarray:
    """(k, j, i) share of a sphere, of a radius in the band, whose edges have gradients towards each voxel."""
    voxels, normals, areas = edges
    votes = np.zeros(int(np.prod(shape)), dtype=np.float32)
    for radius in np.arange(band_mm[0], band_mm[1] + 1e-6, settings.radius_step_mm):
        place = np.rint(voxels + radius / WORK_MM * normals).astype(np.int64)
        inside = ((place >= 0) & (place < shape)).all(axis=1)
        index = np.ravel_multi_index(tuple(place[inside].T), shape)
        votes += np.bincount(index, areas[inside] / (4 * np.pi * radius**2), votes.size).astype(np.float32)
    sigma = settings.vote_sigma_mm / WORK_MM
    gathered: np.ndarray = ndimage.gaussian_filter(votes.reshape(shape), sigma, mode="constant")
    return np.asarray(gathered * (2 * np.pi) ** 1.5 * sigma**3 * settings.radius_step_mm)


def _by_rays(limb: LimbImage, place_mm: Floats, *, settings: BallCandidateSettings) -> BallCandidate | None:
    """Fit a sphere to the points where rays from a position leave the bright region; None without one."""
    centre, rays = place_mm, sphere_directions()
    steps = np.arange(0.0, settings.radii_mm[1] + 3.0, 0.5)
    for _ in range(settings.rounds):
        values = read_at(limb.intensity, limb.grid, centre + steps[None, :, None] * rays[:, None, :])
        level = float(np.median(values[:, :3]))
        drops = values[:, :-4] - values[:, 4:]
        end = np.argmax(drops > settings.least_drop * level, axis=1)
        # The steepest sample within a millimetre after the first decrease that is large enough.
        window = np.minimum(end[:, None] + np.arange(3), drops.shape[1] - 1)
        best = np.take_along_axis(window, np.argmax(np.take_along_axis(drops, window, 1), axis=1)[:, None], 1)[:, 0]
        clear = drops[np.arange(len(rays)), best] > settings.least_drop * level
        if level <= 0 or clear.mean() < settings.least_share:
            return None
        reach = steps[best] + 1.0
        radius = float(np.median(reach[clear]))
        good = clear & (np.abs(reach - radius) < 1.0 + 0.2 * radius)
        if good.mean() < 0.6 * settings.least_share:
            return None
        centre, radius = _sphere(centre + reach[good, None] * rays[good])
        if (
            not settings.radii_mm[0] <= radius <= settings.radii_mm[1]
            or np.linalg.norm(centre - place_mm) > 2 * settings.radii_mm[1]
        ):
            return None
    if good.mean() < settings.least_share:
        return None
    return BallCandidate(centre_mm=centre, radius_mm=radius, share=float(good.mean()))


def _sphere(points: Floats) -> tuple[Floats, float]:
    """Return centre and radius of the sphere that fits points (n, 3) best: |p|^2 = 2 c p + (r^2 - |c|^2)."""
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
