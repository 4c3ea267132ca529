"""Refit of the inner surface of cartilage: the offset of the edge along the normals of a bone's surface."""

from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr

from marey.arrays import Floats, Mask, freeze_fields
from marey.knee.bones.marrow import Kind, PerKind
from marey.knee.cartilage.evidence import DEPTHS_MM, OVER_MM, STEP_MM, STRAY, Profiles, Tissues
from marey.knee.space.mesh_graph import MeshGraph

OFFSETS_MM = np.arange(-7, 8) * 0.2
"""Candidate offsets [mm] of the edge, outward of the bone's surface; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class InnerSurfaceSettings:
    """Settings for refitting the inner surface of cartilage.

    Values without a stated source were chosen by hand.
    """

    bone_sd_mm: PerKind = field(default_factory=lambda: PerKind(dark=0.5, bright=0.8))
    """Standard deviation [mm] of the bone's surface, by its marrow: a bone with dark marrow was cut along the edge
    at which cartilage begins; bright marrow ends at the cortex, and fades into cartilage."""
    slope_sd: PerKind = field(default_factory=lambda: PerKind(dark=0.15, bright=0.3))
    """Standard deviation [mm/mm] of the slope of this error over the bone."""
    largest_pair_cost: float = 12.0
    """Largest cost of a pair of neighbouring vertices."""
    least_contrast: float = 0.1
    """Least difference of marrow and cartilage, as a share of the level of cartilage, for the edge between them to
    count."""
    line_mm: float = 1.5
    """Distance [mm] from the bone within which a dark line is searched."""
    line_depth: float = 0.25
    """Least depth of a dark line below marrow and cartilage, as a share of the level of cartilage."""


INNER_SURFACE_DEFAULTS = InnerSurfaceSettings()
"""Default settings for refitting the inner surface of cartilage."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InnerEdge:
    """Where cartilage begins, relative to the bone's surface."""

    offset_mm: Floats
    """(V,) outward along the normal."""
    sd_mm: Floats
    """(V,) standard deviation by each vertex's own profile and `bone_sd_mm`."""

    def __post_init__(self) -> None:
        freeze_fields(self, "offset_mm", "sd_mm")


def inner_edge(
    costs: Floats, graph: MeshGraph, marrow: Kind, *, settings: InnerSurfaceSettings = INNER_SURFACE_DEFAULTS
) -> InnerEdge:
    """Choose the offset of the edge at each vertex, as a smooth sheet.

    Args:
        costs: (V, S) cost of each of `OFFSETS_MM` by the image, from `inner_costs`, summed over the images.
        graph: Mesh graph of the bone.
        marrow: Whether it is dark beside cartilage, in any of the images, or bright.
        settings: Tuned constants of the algorithm.
    """
    own = costs + 0.5 * (OFFSETS_MM / settings.bone_sd_mm.of(marrow)) ** 2
    beliefs = graph.choose(own, OFFSETS_MM, settings.slope_sd.of(marrow), settings.largest_pair_cost)
    chance = np.exp(own.min(1, keepdims=True) - own)
    chance /= chance.sum(1, keepdims=True)
    mean = chance @ OFFSETS_MM
    sd = np.sqrt((chance * (OFFSETS_MM - mean[:, None]) ** 2).sum(1))
    return InnerEdge(offset_mm=_between(beliefs), sd_mm=sd)


def inner_costs(
    profiles: Profiles,
    seen: Tissues,
    thickness_mm: Floats,
    present: Mask,
    offset_mm: Floats,
    *,
    settings: InnerSurfaceSettings = INNER_SURFACE_DEFAULTS,
) -> Floats:
    """Return the cost (V, S) of each offset of the edge between bone and cartilage, at `OFFSETS_MM`.

    The outer surface is kept, and what lies beyond it is ignored.

    Args:
        profiles: Grey values, read from the bone's surface moved by `offset_mm`.
        seen: The tissues.
        thickness_mm: (V,) from there to the outer surface.
        present: (V,) where cartilage is; elsewhere all costs are 0.
        offset_mm: (V,) distance of the profile's origin outward of the bone's first surface.
        settings: Tuned constants of the algorithm.
    """
    costs = np.zeros((len(offset_mm), len(OFFSETS_MM)))
    used = np.flatnonzero(present & _edge_visible(seen, thickness_mm - profiles.blur_mm, settings=settings))
    values, marrow = seen.relative[used], seen.marrow[used, None]
    blur, thick = profiles.blur_mm[used, None], thickness_mm[used, None]
    beyond = (thick + 1.5 * blur < DEPTHS_MM) & (thick + 1.5 * blur + OVER_MM > DEPTHS_MM)
    over = (values * beyond).sum(1, keepdims=True) / np.maximum(beyond.sum(1, keepdims=True), 1)
    outer = (np.where(beyond.any(1, keepdims=True), over, 1.0) - 1) * ndtr((DEPTHS_MM - thick) / blur)
    share = np.where(thick >= DEPTHS_MM, STEP_MM / profiles.correlation_mm[used, None], 0.0)
    for n, offset in enumerate(OFFSETS_MM):
        inner = ndtr((DEPTHS_MM - (offset - offset_mm[used, None])) / blur)
        off = (values - (marrow + (1 - marrow) * inner + outer)) / seen.spread
        costs[used, n] = -(share * np.log((1 - STRAY) * np.exp(-0.5 * off**2) + STRAY)).sum(1)
    return costs


def _edge_visible(seen: Tissues, until_mm: Floats, *, settings: InnerSurfaceSettings) -> Mask:
    """(V,) true where marrow and cartilage differ, without a dark line of cortex, which is bone, between them."""
    within = np.minimum(until_mm, settings.line_mm)[:, None] >= DEPTHS_MM
    above = np.where(within, seen.relative, -np.inf)
    # A line, unlike an edge to dark tissue, has a brighter side farther out.
    after = np.maximum.accumulate(above[:, ::-1], axis=1)[:, ::-1]
    dip = np.minimum(after, seen.marrow[:, None]) - seen.relative
    line = np.where(within & (-settings.line_mm < DEPTHS_MM), dip, 0.0).max(1) > max(
        settings.line_depth, 4 * seen.spread
    )
    return np.asarray((np.abs(1 - seen.marrow) > settings.least_contrast) & ~line)


def _between(beliefs: Floats) -> Floats:
    """Return the offset (V,) of least cost, interpolated by a parabola between the candidates."""
    rows, best = np.arange(len(beliefs)), np.clip(np.argmin(beliefs, 1), 1, len(OFFSETS_MM) - 2)
    before, least, after = (beliefs[rows, best + step] for step in (-1, 0, 1))
    beside = np.clip(0.5 * (before - after) / np.maximum(before - 2 * least + after, 1e-6), -1, 1)
    return np.asarray(OFFSETS_MM[best] + beside * (OFFSETS_MM[1] - OFFSETS_MM[0]))
