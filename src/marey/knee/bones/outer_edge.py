"""Where within the voxels a bone with dark marrow ends: halfway from black cortex to what lies just outside."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.knee.space.volume import Grid

_APART_MM = 1.0
"""How far apart the surface's points are of which profiles are taken."""
_FEWEST_POINTS = 500
_STEP_MM, _REACH_MM = 0.25, 3.5
_NEAR, _NEAR_MM = 24, 2.0
"""Profiles are averaged over so many points, weighted by a Gaussian of this width: noise falls to a fifth."""
_JUST_OUTSIDE_MM = (0.5, 1.0)
"""Beyond the blur of an edge, and not yet beyond a film of fat."""
_LINE_MM = (-1.5, 0.5)
"""Where the black line of cortex is looked for."""
_MOST_MM = 1.5
_ROUNDS = 2
_BAND_MM = 3.0
_SPREAD = 8
"""Points whose steps are averaged at a voxel."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Points:
    """Points on a bone's surface."""

    places_mm: Floats
    """(N, 3) along k, j, i from the array's first voxel."""
    outward: Floats
    """(N, 3)."""
    near: Integers
    """(N, M) the points about each, itself among them."""
    weights: Floats
    """(N, M) of those: less where they are far or face another way."""

    def averaged(self, values: Floats, weights: Floats) -> Floats:
        """(N, ...) values (N, ...) of the points about each, averaged by weights (N, M); 0 without weight."""
        weighted = np.einsum("nm,nm...->n...", weights, values[self.near])
        total = weights.sum(axis=1).reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(weighted / np.maximum(total, 1e-6))


def at_half_level(
    intensity: np.ndarray, distance_mm: np.ndarray, grid: Grid, *, no_signal: float | None = None
) -> np.ndarray:
    """Move a bone's edge to half the step from its cortex to what lies just outside.

    Between marrow and fat lies cortex, darker than both and thinner than a voxel or two; half the step from marrow to
    fat lies outside the bone. How deep the line is cannot be read in so thin a line, but cortex gives no signal at
    all: it is taken to be as dark as air where it is seen to be darker than the marrow. Profiles along the normals are
    averaged over neighbouring points, so that the edge is found to a small part of a voxel in spite of noise.

    Args:
        intensity: (k, j, i) without bias; marrow dark.
        distance_mm: (k, j, i) to the edge as it is known to a voxel or two, positive inside.
        grid: Of both.
        no_signal: Level of air in the image; without it a line is taken to be as dark as it looks.

    Returns:
        (k, j, i) distance to the moved edge, positive inside.
    """
    for _ in range(_ROUNDS):
        points = _surface_points(distance_mm, np.array(grid.array_spacing_mm))
        steps, clear = _steps_to_edge(points, intensity, np.array(grid.array_spacing_mm), no_signal)
        distance_mm = distance_mm + _spread(points, steps, clear, distance_mm, np.array(grid.array_spacing_mm))
    return distance_mm


def _surface_points(distance: np.ndarray, spacing: Floats) -> _Points:
    gradient = np.stack(np.gradient(ndimage.gaussian_filter(distance, 0.6 / spacing), *spacing), axis=-1)
    depth = max(spacing.min(), 0.5)
    edge = np.argwhere((distance > 0) & (distance < depth))
    area = len(edge) * spacing.prod() / depth
    edge = edge[:: max(1, int(len(edge) / max(area / _APART_MM**2, _FEWEST_POINTS)))]
    outward = -gradient[tuple(edge.T)]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-6)
    places = edge * spacing + outward * distance[tuple(edge.T)][:, None]
    away, near = cKDTree(places).query(places, k=min(_NEAR, len(places)))
    alike = np.clip((outward[near] * outward[:, None]).sum(axis=-1), 0, 1) ** 2
    weights = np.exp(-0.5 * (away / _NEAR_MM) ** 2) * alike
    return _Points(places_mm=places, outward=outward, near=near, weights=weights)


def _steps_to_edge(
    points: _Points, intensity: np.ndarray, spacing: Floats, no_signal: float | None
) -> tuple[Floats, Floats]:
    """(N,) how far [mm] outward of each point the edge lies, and how clear it is there, 0 to 1."""
    offsets = np.arange(-_REACH_MM, _REACH_MM + _STEP_MM / 2, _STEP_MM)
    places = (points.places_mm[:, None] + offsets[:, None] * points.outward[:, None]) / spacing
    single = ndimage.map_coordinates(intensity, np.moveaxis(places, -1, 0), order=1, mode="nearest")
    deep = single[:, offsets < _LINE_MM[0]]
    noise = 1.4826 * float(np.median(np.abs(deep - np.median(deep))))
    profile = points.averaged(single, points.weights)
    in_line = np.flatnonzero((offsets >= _LINE_MM[0]) & (offsets <= _LINE_MM[1]))
    darkest = in_line[profile[:, in_line].argmin(axis=1)]
    line = profile[np.arange(len(profile)), darkest]
    marrow = np.median(profile[:, offsets < _LINE_MM[0]], axis=1)
    cortex = line if no_signal is None else np.where(line < marrow, np.minimum(line, no_signal), line)
    index, share, outside = _first_rise(profile, darkest, line, cortex, noise)
    steps = np.clip(offsets[index] + share * _STEP_MM, -_MOST_MM, _MOST_MM)
    return steps, np.clip((outside - line) / (2 * noise + 1e-6) - 0.5, 0, 1)


def _first_rise(
    profile: Floats, darkest: Integers, line: Floats, cortex: Floats, noise: float
) -> tuple[Integers, Floats, Floats]:
    """(N,) after which sample, and by what share of a step, a profile first rises through half of its own step.

    The third is the level just outside; where nothing rises it is that of the line.
    """
    first, last = (round(each / _STEP_MM) for each in _JUST_OUTSIDE_MM)
    count = profile.shape[1] - last
    outside = np.mean([profile[:, shift : shift + count] for shift in range(first, last + 1)], axis=0)
    above = profile[:, :count] - (cortex[:, None] + outside) / 2
    rises = (above[:, 1:] >= 0) & (above[:, :-1] < 0)
    rises &= (np.arange(1, count) > darkest[:, None]) & (outside[:, 1:] - line[:, None] > noise)
    index, rows = rises.argmax(axis=1), np.arange(len(profile))
    before, after = above[rows, index], above[rows, index + 1]
    share = np.clip(-before / np.maximum(after - before, 1e-6), 0, 1)
    return index, share, np.where(rises.any(axis=1), outside[rows, index + 1], line)


def _spread(points: _Points, steps: Floats, clear: Floats, distance: np.ndarray, spacing: Floats) -> np.ndarray:
    """(k, j, i) the points' steps, averaged over the surface, at the voxels about it."""
    weights = points.weights * clear[points.near]
    even = points.averaged(steps, weights) * np.clip(weights.sum(axis=1), 0, 1)
    band = np.argwhere(np.abs(distance) < _BAND_MM)
    away, near = cKDTree(points.places_mm).query(band * spacing, k=min(_SPREAD, len(even)))
    share = 1 / (away + 0.5)
    moved = np.zeros_like(distance)
    moved[tuple(band.T)] = (share * even[near]).sum(axis=1) / share.sum(axis=1)
    return moved
