"""Edge of a bone with dark marrow to a fraction of a voxel: half the step from black cortex to what lies outside."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.knee.space.volume import VoxelGrid


@dataclass(frozen=True, kw_only=True)
class OuterEdgeSettings:
    """Settings for finding the outer edge of cortex about dark marrow within the voxels.

    Values without a stated source were chosen by hand.
    """

    point_spacing_mm: float = 1.0
    """Spacing [mm] of the points on the surface at which profiles are sampled."""
    fewest_points: int = 500
    """Least number of such points; on small surfaces they are closer together."""
    step_mm: float = 0.25
    """Spacing [mm] of the samples of a profile."""
    reach_mm: float = 3.5
    """Half the length [mm] of a profile."""
    averaged_points: int = 24
    """Number of neighbouring profiles that are averaged: noise decreases to a fifth."""
    averaging_mm: float = 2.0
    """Standard deviation [mm] of the Gaussian weights of the neighbouring profiles."""
    outside_mm: tuple[float, float] = (0.5, 1.0)
    """Range [mm] outside an edge where the outer level is measured: beyond the blur of the edge, and not yet beyond
    a film of fat."""
    cortex_mm: tuple[float, float] = (-1.5, 0.5)
    """Range [mm] about the known edge in which the dark line of cortex is searched."""
    largest_step_mm: float = 1.5
    """Largest distance [mm] by which the edge moves in one round."""
    rounds: int = 2
    """Number of rounds."""
    band_mm: float = 3.0
    """Half the width [mm] of the band of voxels whose distance is updated."""
    spread_points: int = 8
    """Number of points whose steps are averaged at a voxel."""


OUTER_EDGE_DEFAULTS = OuterEdgeSettings()
"""Default settings for finding the outer edge of cortex about dark marrow within the voxels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Points:
    """Points on a bone's surface."""

    places_mm: Floats
    """(N, 3) along k, j, i from the array's first voxel."""
    outward: Floats
    """(N, 3)."""
    near: Integers
    """(N, M) indices of the points near each point, including itself."""
    weights: Floats
    """(N, M) weights of these points: less where they are far or their normals differ."""

    def averaged(self, values: Floats, weights: Floats) -> Floats:
        """Return values (N, ...) averaged over the points near each point by weights (N, M); 0 without weight."""
        weighted = np.einsum("nm,nm...->n...", weights, values[self.near])
        total = weights.sum(axis=1).reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(weighted / np.maximum(total, 1e-6))


def at_half_level(
    intensity: np.ndarray,
    distance_mm: np.ndarray,
    grid: VoxelGrid,
    *,
    no_signal: float | None = None,
    settings: OuterEdgeSettings = OUTER_EDGE_DEFAULTS,
) -> np.ndarray:
    """Move a bone's edge to half the step from its cortex to what lies just outside.

    Between marrow and fat lies cortex, darker than both and thinner than a voxel or two; half the step from marrow to
    fat lies outside the bone. The depth of so thin a line cannot be measured, but cortex gives no signal at all: its
    level is assumed to be that of air wherever it appears darker than the marrow. Profiles along the normals are
    averaged over neighbouring points, so that the edge is found to a fraction of a voxel in spite of noise.

    Args:
        intensity: (k, j, i) without bias; marrow dark.
        distance_mm: (k, j, i) distance to the edge, known to a voxel or two, positive inside.
        grid: Of both.
        no_signal: Level of air in the image; without it the observed level of the line is used.
        settings: Tuned constants of the algorithm.

    Returns:
        (k, j, i) distance to the moved edge, positive inside.
    """
    for _ in range(settings.rounds):
        points = _surface_points(distance_mm, np.array(grid.array_spacing_mm), settings=settings)
        steps, clear = _steps_to_edge(points, intensity, np.array(grid.array_spacing_mm), no_signal, settings=settings)
        distance_mm = distance_mm + _spread(
            points, steps, clear, distance_mm, np.array(grid.array_spacing_mm), settings=settings
        )
    return distance_mm


def _surface_points(distance: np.ndarray, spacing: Floats, *, settings: OuterEdgeSettings) -> _Points:
    gradient = np.stack(np.gradient(ndimage.gaussian_filter(distance, 0.6 / spacing), *spacing), axis=-1)
    depth = max(spacing.min(), 0.5)
    edge = np.argwhere((distance > 0) & (distance < depth))
    area = len(edge) * spacing.prod() / depth
    edge = edge[:: max(1, int(len(edge) / max(area / settings.point_spacing_mm**2, settings.fewest_points)))]
    outward = -gradient[tuple(edge.T)]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-6)
    places = edge * spacing + outward * distance[tuple(edge.T)][:, None]
    away, near = cKDTree(places).query(places, k=min(settings.averaged_points, len(places)))
    similar = np.clip((outward[near] * outward[:, None]).sum(axis=-1), 0, 1) ** 2
    weights = np.exp(-0.5 * (away / settings.averaging_mm) ** 2) * similar
    return _Points(places_mm=places, outward=outward, near=near, weights=weights)


def _steps_to_edge(
    points: _Points, intensity: np.ndarray, spacing: Floats, no_signal: float | None, *, settings: OuterEdgeSettings
) -> tuple[Floats, Floats]:
    """Return how far [mm] outward of each point the edge lies (N,), and how clear it is there (N,), 0 to 1."""
    offsets = np.arange(-settings.reach_mm, settings.reach_mm + settings.step_mm / 2, settings.step_mm)
    places = (points.places_mm[:, None] + offsets[:, None] * points.outward[:, None]) / spacing
    single = ndimage.map_coordinates(intensity, np.moveaxis(places, -1, 0), order=1, mode="nearest")
    deep = single[:, offsets < settings.cortex_mm[0]]
    noise = 1.4826 * float(np.median(np.abs(deep - np.median(deep))))
    profile = points.averaged(single, points.weights)
    in_line = np.flatnonzero((offsets >= settings.cortex_mm[0]) & (offsets <= settings.cortex_mm[1]))
    darkest = in_line[profile[:, in_line].argmin(axis=1)]
    line = profile[np.arange(len(profile)), darkest]
    marrow = np.median(profile[:, offsets < settings.cortex_mm[0]], axis=1)
    cortex = line if no_signal is None else np.where(line < marrow, np.minimum(line, no_signal), line)
    index, share, outside = _first_rise(profile, darkest, line, cortex, noise, settings=settings)
    steps = np.clip(offsets[index] + share * settings.step_mm, -settings.largest_step_mm, settings.largest_step_mm)
    return steps, np.clip((outside - line) / (2 * noise + 1e-6) - 0.5, 0, 1)


def _first_rise(
    profile: Floats, darkest: Integers, line: Floats, cortex: Floats, noise: float, *, settings: OuterEdgeSettings
) -> tuple[Integers, Floats, Floats]:
    """Find where each profile first rises through half of its own step.

    Returns:
        (N,) index of the sample before the rise, (N,) share of a step after it, and (N,) level just outside, which is
        that of the line where no profile rises.
    """
    first, last = (round(each / settings.step_mm) for each in settings.outside_mm)
    count = profile.shape[1] - last
    outside = np.mean([profile[:, shift : shift + count] for shift in range(first, last + 1)], axis=0)
    above = profile[:, :count] - (cortex[:, None] + outside) / 2
    rises = (above[:, 1:] >= 0) & (above[:, :-1] < 0)
    rises &= (np.arange(1, count) > darkest[:, None]) & (outside[:, 1:] - line[:, None] > noise)
    index, rows = rises.argmax(axis=1), np.arange(len(profile))
    before, after = above[rows, index], above[rows, index + 1]
    share = np.clip(-before / np.maximum(after - before, 1e-6), 0, 1)
    return index, share, np.where(rises.any(axis=1), outside[rows, index + 1], line)


def _spread(
    points: _Points, steps: Floats, clear: Floats, distance: np.ndarray, spacing: Floats, *, settings: OuterEdgeSettings
) -> np.ndarray:
    """(k, j, i) the steps of the points, averaged over the surface, at the voxels near it."""
    weights = points.weights * clear[points.near]
    even = points.averaged(steps, weights) * np.clip(weights.sum(axis=1), 0, 1)
    band = np.argwhere(np.abs(distance) < settings.band_mm)
    away, near = cKDTree(points.places_mm).query(band * spacing, k=min(settings.spread_points, len(even)))
    share = 1 / (away + 0.5)
    moved = np.zeros_like(distance)
    moved[tuple(band.T)] = (share * even[near]).sum(axis=1) / share.sum(axis=1)
    return moved
