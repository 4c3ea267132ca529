"""Refinement of a bone's edge on the image's own voxels, by the local brightness inside and outside."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from marey.arrays import Floats
from marey.knee.bones.marrow import Kind, PerKind
from marey.knee.bones.outer_edge import OUTER_EDGE_DEFAULTS, OuterEdgeSettings, at_half_level
from marey.knee.space.distances import signed_distance
from marey.knee.space.minimal_cut import minimal_cut
from marey.knee.space.resampling import smoothed
from marey.knee.space.volume import VoxelGrid


@dataclass(frozen=True, kw_only=True)
class EdgeRing:
    """Where the level outside a bone is measured."""

    from_mm: float
    """Least distance [mm] outside the edge."""
    to_mm: float
    """Largest distance [mm] outside the edge."""
    sigma_mm: float
    """Standard deviation [mm] of the Gaussian over which the level is averaged."""
    band_mm: float
    """How far [mm] the edge may move."""


@dataclass(frozen=True, kw_only=True)
class BoneEdgeSettings:
    """Settings for refining a bone's edge.

    Values without a stated source were chosen by hand.
    """

    coarse_nats_mm: PerKind = field(default_factory=lambda: PerKind(dark=1.5, bright=6.0))
    """Price [nats per mm, for a voxel of 1 mm] of a bone's surface in the first round."""
    fine_nats_mm: PerKind = field(default_factory=lambda: PerKind(dark=1.5, bright=3.0))
    """The same in later rounds. It is larger for bright marrow, which only the thin black cortex separates from fat
    of the same brightness."""
    outward: PerKind = field(default_factory=lambda: PerKind(dark=0.5, bright=0.3))
    """How far the edge may move outward, as a share of how far it may move inward; for dark marrow in small bones
    only."""
    most_nats: float = 4.0
    """Largest absolute value of the log odds of a voxel."""
    inside_mm: float = 4.0
    """Standard deviation [mm] of the Gaussian over which the level of marrow is averaged."""
    outside_mm: float = 2.0
    """Standard deviation [mm] of the Gaussian over which the level of the dark line about bright marrow is
    averaged."""
    least_step: float = 0.5
    """Least step down from bright marrow to its surroundings, as a share of the median step about the same bone."""
    cortex_mm: tuple[float, float] = (0.4, 2.5)
    """Least and largest usual thickness [mm] of cortex about bright marrow."""
    soft_tissue: tuple[float, float] = (0.35, 0.75)
    """Brightness of muscle and cartilage beside bright marrow, as shares of marrow's level."""
    soft_nats: float = 1.0
    """Log odds against bone from such voxels."""
    fat_smoothing_mm: float = 0.7
    """Standard deviation [mm] of the smoothing before fat is compared with dark marrow."""
    fat_steps: float = 3.0
    """Fat counts as brighter than dark marrow when its level exceeds the median of marrow by this multiple of the
    distance from the median to the 95th percentile of marrow."""
    fat_share: float = 0.12
    """Least share of the brighter surroundings of a bone that is at the level of fat."""
    fewest_voxels: int = 200
    """Least number of voxels from which a level of fat is measured."""
    fat_from_bright_mm: float = 1.0
    """Least distance [mm] of fat from bright voxels, whose partial volume resembles fat."""
    fat_bright: float = 6.0
    """Voxels are bright when they exceed marrow by this multiple of the step from marrow to fat."""
    blur_mm: float = 1.6
    """Largest width [mm] of the layer that resembles fat where cartilage is smoothed into marrow."""
    faint_smoothing_mm: float = 0.5
    """Standard deviation [mm] of the smoothing before thin films of fat are searched."""
    coarse_ring: EdgeRing = EdgeRing(from_mm=0.7, to_mm=5.0, sigma_mm=2.0, band_mm=4.0)
    """Where the level outside a bone is measured in the first round."""
    fine_ring: EdgeRing = EdgeRing(from_mm=0.4, to_mm=2.2, sigma_mm=1.2, band_mm=2.0)
    """The same in later rounds, when the edge is known to a voxel or two."""
    outer_edge: OuterEdgeSettings = OUTER_EDGE_DEFAULTS
    """Settings for the last step about dark marrow, which finds the edge within the voxels."""


BONE_EDGE_DEFAULTS = BoneEdgeSettings()
"""Default settings for refining a bone's edge."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneImage:
    """The part of an image about a bone, with the distance to the bone's coarse edge."""

    intensity: np.ndarray
    """(k, j, i) without bias."""
    distance_mm: np.ndarray
    """(k, j, i) distance to the coarse edge, positive inside."""
    prior_nats: np.ndarray
    """(k, j, i) log odds of bone by other knowledge, such as a template."""
    grid: VoxelGrid
    rough: bool = True
    """Whether the coarse edge may be off by more than a voxel or two."""
    small: bool = False
    """Whether it is a patella, whose edge growing finds well, so that it need not move far outward."""
    no_signal: float | None = None
    """Level of air in the image; None where no air is in view."""


def edge_in_images(
    pieces: Sequence[BoneImage], kinds: Sequence[Kind], *, settings: BoneEdgeSettings = BONE_EDGE_DEFAULTS
) -> np.ndarray:
    """Refine a bone's edge by the image with dark marrow if there is one: it shows the outside of the cortex.

    Args:
        pieces: The bone's part of each image of the same knee.
        kinds: Whether marrow is dark or bright, for each image.
        settings: Tuned constants of the algorithm.

    Returns:
        (k, j, i) signed distance [mm], positive inside, exact near the edge.
    """
    lead = kinds.index("dark") if "dark" in kinds else 0
    others = [
        marrow_odds(piece, kind, settings=settings)
        if kind == kinds[lead]
        else soft_tissue_odds(piece, settings=settings)
        for index, (piece, kind) in enumerate(zip(pieces, kinds, strict=True))
        if index != lead
    ]
    return refine_edge(pieces[lead], kinds[lead], others, settings=settings)


def refine_edge(
    piece: BoneImage,
    kind: Kind,
    others: list[np.ndarray] | None = None,
    *,
    settings: BoneEdgeSettings = BONE_EDGE_DEFAULTS,
) -> np.ndarray:
    """Move a bone's edge from its coarse place to where the image changes.

    Args:
        piece: The bone's part of the image.
        kind: Whether marrow is dark or bright. The black line of cortex about bright marrow is part of the bone.
        others: Log odds (k, j, i) from further images of the same place.
        settings: Tuned constants of the algorithm.

    Returns:
        (k, j, i) signed distance [mm], positive inside, exact near the edge.
    """
    settled = piece.prior_nats + sum(others or [], np.zeros(1, dtype=np.float32))
    distance = piece.distance_mm
    if kind == "dark" or piece.rough:
        distance = _cut(piece, kind, settled, distance, settings.coarse_ring, settings=settings)
    # The edge is now known to a voxel or two: repeat with the levels just beside it.
    distance = _cut(piece, kind, settled, distance, settings.fine_ring, settings=settings)
    if kind == "dark":
        moved = at_half_level(
            piece.intensity, distance, piece.grid, no_signal=piece.no_signal, settings=settings.outer_edge
        )
        return _one_piece(moved)
    # About bright marrow the edge moves outward in small steps, so that it does not jump over the black line.
    distance = _cut(piece, kind, settled, distance, settings.fine_ring, settings=settings)
    return np.asarray(distance + _cortex(piece, distance, settings=settings))


def _cut(
    piece: BoneImage, kind: Kind, known: np.ndarray, distance: np.ndarray, ring: EdgeRing, *, settings: BoneEdgeSettings
) -> np.ndarray:
    odds = marrow_odds(piece, kind, distance, ring, settings=settings) + known
    outward = (1.0 if kind == "dark" and not piece.small else settings.outward.of(kind)) * ring.band_mm
    odds = np.where(distance > ring.band_mm, 100.0, np.where(distance < -outward, -100.0, odds))
    spacing = piece.grid.array_spacing_mm
    price = (settings.fine_nats_mm if ring is settings.fine_ring else settings.coarse_nats_mm).of(kind)
    inside = minimal_cut(odds.astype(np.float32), distance > 0, spacing, surface_nats_mm=price)
    return signed_distance(_main_part(inside > 0.5), spacing)


def marrow_odds(
    piece: BoneImage,
    kind: Kind,
    distance: np.ndarray | None = None,
    ring: EdgeRing | None = None,
    *,
    settings: BoneEdgeSettings = BONE_EDGE_DEFAULTS,
) -> np.ndarray:
    """(k, j, i) log odds of marrow against what is outside, by the local level halfway between both."""
    distance, ring = (piece.distance_mm if distance is None else distance), ring or settings.coarse_ring
    intensity, grid = piece.intensity, piece.grid
    level = _local_level(intensity, distance > 1.0, grid, settings.inside_mm)
    deep = intensity[distance > 2.5] if (distance > 2.5).any() else intensity[distance > 0]
    noise = max(1.4826 * float(np.median(np.abs(deep - np.median(deep)))), 0.02 * abs(float(np.median(deep))))
    if kind == "dark":
        beside = (distance < -ring.from_mm) & (distance > -ring.to_mm)
        outside = _local_level(np.minimum(intensity, np.percentile(intensity[beside], 99)), beside, grid, ring.sigma_mm)
        step = np.maximum(outside - level, 2 * noise)
    else:
        share = _darkest_near(intensity, distance, grid, settings=settings) / np.maximum(level, 1e-6) - 1
        # Where no dark line is near, the edge still lies within marrow: a small step would keep it there.
        usual = float(np.median(share[np.abs(distance) < 1.0])) if (np.abs(distance) < 1.0).any() else 0.0
        step = np.minimum(np.minimum(share, settings.least_step * usual) * level, -2 * noise)
    odds = _half_level_odds(intensity - level, step, noise)
    if kind == "dark" and ring is settings.fine_ring:
        odds = _odds_against_fat(piece, distance, level, noise, odds, settings=settings)
    return np.asarray(np.clip(odds, -settings.most_nats, settings.most_nats))


def _half_level_odds(above: np.ndarray, step: np.ndarray | float, noise: float) -> np.ndarray:
    return np.asarray(-(above - step / 2) * step / (noise**2 + (step / 4) ** 2))


def _odds_against_fat(
    piece: BoneImage,
    distance: np.ndarray,
    level: np.ndarray,
    noise: float,
    odds: np.ndarray,
    *,
    settings: BoneEdgeSettings,
) -> np.ndarray:
    """(k, j, i) the odds, reduced where voxels resemble the fat next to dark marrow.

    Outside a film of fat lies muscle, and by the level halfway to muscle the film would count as marrow.
    """
    even = smoothed(piece.intensity, piece.grid, settings.fat_smoothing_mm)
    fat, marrow, most = _fat_level(even[distance > 2.5], even[(distance < -1) & (distance > -6)], settings=settings)
    if fat is None:
        return odds
    step, middle = fat - marrow, level + (most - marrow) / 2
    like_fat = (even > most) & (even < marrow + 2 * step)
    above = piece.intensity - middle
    surely = (
        _far_from_bright(even, marrow + settings.fat_bright * step, piece.grid, settings=settings)
        | _thick(like_fat, piece.grid, settings=settings)
    ) & (above < 2 * step)
    odds = np.where(surely, np.minimum(odds, _half_level_odds(above, step, noise)), odds)
    # Elsewhere it may be the blur of bright tissue or a thin film of fat: no evidence for marrow either.
    faint = smoothed(piece.intensity, piece.grid, settings.faint_smoothing_mm) - middle
    return np.where((faint > step / 2) & (faint < 2 * step), np.minimum(odds, 0), odds)


def _far_from_bright(even: np.ndarray, bright: float, grid: VoxelGrid, *, settings: BoneEdgeSettings) -> np.ndarray:
    """(k, j, i) true far from bright tissue such as cartilage, whose partial volume resembles fat."""
    size = [2 * round(settings.fat_from_bright_mm / each) + 1 for each in grid.array_spacing_mm]
    return np.asarray(ndimage.maximum_filter(even, size) < bright)


def _thick(like_fat: np.ndarray, grid: VoxelGrid, *, settings: BoneEdgeSettings) -> np.ndarray:
    """(k, j, i) true in layers like fat that are wider than the blur of bright tissue, and than a voxel."""
    box = [max(2, round(settings.blur_mm / each)) for each in grid.array_spacing_mm]
    return np.asarray(ndimage.binary_opening(like_fat, np.ones(box)))


def _fat_level(deep: np.ndarray, ring: np.ndarray, *, settings: BoneEdgeSettings) -> tuple[float | None, float, float]:
    """Return the level of fat beside a bone, the median of its marrow, and the 95th percentile of its marrow.

    The first is None where no level stands out, or none that exceeds the variation of marrow clearly.
    """
    if len(deep) < settings.fewest_voxels or len(ring) < settings.fewest_voxels:
        return None, 0.0, 0.0
    marrow, most = np.percentile(deep, [50, 95])
    deviation = 1.4826 * float(np.median(np.abs(deep - marrow)))
    bins = np.arange(most, max(float(ring.max()), most + 10 * deviation), deviation / 2)
    counts = np.convolve(np.histogram(ring, bins)[0], np.ones(5), "same")
    fat = float(bins[counts.argmax()] + deviation / 4)
    share = float((np.abs(ring[ring > most] - fat) < 1.5 * deviation).mean()) if (ring > most).any() else 0.0
    clear = fat - marrow > settings.fat_steps * (most - marrow) and share > settings.fat_share
    return fat if clear else None, float(marrow), float(most)


def soft_tissue_odds(piece: BoneImage, *, settings: BoneEdgeSettings = BONE_EDGE_DEFAULTS) -> np.ndarray:
    """(k, j, i) log odds from an image with bright marrow beside one with dark: against muscle and cartilage only.

    In that image fat is as bright as marrow, and cortex as black as tendon: neither is evidence.
    """
    marrow = _local_level(piece.intensity, piece.distance_mm > 2.0, piece.grid, 2 * settings.inside_mm)
    share = smoothed(piece.intensity, piece.grid, 0.5) / np.maximum(marrow, 1e-6)
    soft = (share > settings.soft_tissue[0]) & (share < settings.soft_tissue[1])
    return np.where(soft, -settings.soft_nats, 0.0)


def _local_level(intensity: np.ndarray, mask: np.ndarray, grid: VoxelGrid, sigma_mm: float) -> np.ndarray:
    weight = smoothed(mask, grid, sigma_mm)
    return np.asarray(smoothed(intensity * mask, grid, sigma_mm) / np.maximum(weight, 1e-3))


def _darkest_near(
    intensity: np.ndarray, distance: np.ndarray, grid: VoxelGrid, *, settings: BoneEdgeSettings
) -> np.ndarray:
    """(k, j, i) the dark level just outside bright marrow, of cortex or cartilage."""
    size = [2 * max(0, int(1.5 / spacing)) + 1 for spacing in grid.array_spacing_mm]
    darkest = ndimage.minimum_filter(smoothed(intensity, grid, 0.3), size)
    return _local_level(darkest, np.abs(distance) < 2, grid, settings.outside_mm)


def _main_part(mask: np.ndarray) -> np.ndarray:
    labels, count = ndimage.label(mask)
    if count > 1:
        mask = labels == 1 + int(np.bincount(labels.ravel())[1:].argmax())
    return np.asarray(ndimage.binary_fill_holes(mask))


def _one_piece(distance: np.ndarray) -> np.ndarray:
    """(k, j, i) a signed distance without islands and holes."""
    inside = _main_part(distance > 0)
    return np.asarray(np.where(inside, np.maximum(distance, 1e-3), np.minimum(distance, -1e-3)))


def _cortex(piece: BoneImage, distance: np.ndarray, *, settings: BoneEdgeSettings) -> np.ndarray:
    """(k, j, i) thickness [mm] of the black line of cortex about bright marrow; 0 beside cartilage and without a line.

    The outer end of the line is visible where fat lies outside it. Beside muscle and tendon, where it is not, the
    median thickness of the visible places is used.
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
    usual = float(np.clip(np.median(outer[seen]), *settings.cortex_mm)) if seen.sum() > 50 else 0.0
    wanted = np.where(seen, np.clip(outer, 0, 2 * usual), usual) * black
    tree = cKDTree(edge * spacing)
    band = np.argwhere(np.abs(distance) < 4)
    away, near = tree.query(band * spacing, k=12)
    share = 1 / (away + 1.0)
    thickness = np.zeros_like(distance)
    thickness[tuple(band.T)] = (share * wanted[near]).sum(axis=1) / share.sum(axis=1)
    return thickness


def _line_ends(profile: Floats, steps: Floats) -> tuple[Floats, np.ndarray, np.ndarray]:
    """Return where the dark line outside the marrow ends, whether both its edges are visible, and whether it exists."""
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
    """(N,) where the dark line ends: half its width from its middle.

    The width is the area missing from the level of marrow, divided by the depth of the darkest lines: the half level of
    a line thinner than a voxel lies too far out, whereas the area does not depend on the blur.
    """
    marrow = np.median(profile[:, steps < -1], axis=1)[:, None]
    near = profile[:, (steps >= -0.5) & (steps <= 1.5)].min(axis=1)
    darkest = float(np.percentile(near[black], 10)) if black.any() else 0.0
    index = np.arange(len(steps))
    line = (index >= start[:, None] - 2) & (index <= (start + length)[:, None] + 1)
    missing = np.clip((marrow - profile) / np.maximum(marrow - darkest, 1e-6), 0, 1) * line
    total = np.maximum(missing.sum(axis=1), 1e-6)
    return np.asarray((missing * steps).sum(axis=1) / total + total * (steps[1] - steps[0]) / 2)
