"""Dense matching of a surface in the images of one instant: from seeds to tuples of matches."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Image, Integers, freeze_fields
from marey.cameras.epipolar import epipolar_lines
from marey.surface.points.acceptance import epipolar_distances
from marey.surface.points.bend import bends
from marey.surface.points.field import Field, Grid
from marey.surface.points.growth import grow
from marey.surface.points.seeds import Seeds, find_seeds
from marey.surface.points.settings import INTERSECTION_DEFAULTS, IntersectionSettings, SurfaceSettings
from marey.surface.points.views import SurfaceView, TemplateSearch

GivenSeeds = Mapping[tuple[int, int], Seeds]
"""Seeds known beforehand, for a template's camera and a searched one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tuples:
    """Tuples of corresponding matches: nodes of one template with their matches in the other images."""

    template: int
    """The template's camera, of C."""
    grid: Grid
    nodes: Integers
    """(n,) of the grid."""
    pixels: Floats
    """(n, C, 2) [px]; NaN without a match."""
    sd: Floats
    """(n, C) standard deviation of the match along the epipolar line [px]; 0 in the template."""
    bend: Floats
    """(n, C, 2) estimated displacement of the match by the surface's curvature [px]; 0 in the template."""
    correlation: Floats
    """(n, C) correlation with the template, in which it is 1."""
    maps: Floats
    """(n, C, 2, 2) affine maps from the template's patches."""
    size: Integers
    """(n, C) sizes of the patches [px]."""
    colour: Image
    """(n, 3) red, green, blue in the template."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "sd", "bend", "correlation", "maps")
        freeze_fields(self, "nodes", "size", dtype=np.int64)
        freeze_fields(self, "colour", dtype=np.uint8)

    def __len__(self) -> int:
        """Count the tuples."""
        return len(self.nodes)


def match_tuples(
    views: Sequence[SurfaceView],
    compared: TemplateSearch,
    settings: SurfaceSettings,
    *,
    given: GivenSeeds | None = None,
    threads: int = 1,
) -> Tuples:
    """Match a template densely in each of the other images, and combine the matches of each patch.

    Args:
        views: Views of all C cameras at one instant.
        compared: The template, and the images in which it is searched.
        settings: Spacing, patches, and limits.
        given: Seeds that are known beforehand; further seeds are searched.
        threads: Number of images that are searched in parallel.

    Returns:
        The tuples; none if no seed was found.
    """
    template, searched = views[compared.template], [views[i] for i in compared.searched]
    grid = Grid.over(template, spacing=settings.spacing, half=settings.patch // 2)
    seeds = list(find_seeds(template, searched, settings, threads=threads))
    for k, other in enumerate(compared.searched):
        known = (given or {}).get((compared.template, other))
        seeds[k] = seeds[k] if known is None else seeds[k].joined_with(known)

    def work(search: SurfaceView, start: Seeds) -> Field:
        limit = _epipolar_limit(template, search, start, settings)
        return grow(template, search, grid, start, settings, epipolar_px=limit)

    with ThreadPoolExecutor(max(1, min(threads, len(searched)))) as pool:
        fields = list(pool.map(work, searched, seeds))
    return merged(views, compared, grid, fields, settings.intersection)


def _epipolar_limit(template: SurfaceView, search: SurfaceView, seeds: Seeds, settings: SurfaceSettings) -> float:
    """Return the largest accepted distance of matches from their lines, derived from those of the seeds [px]."""
    if not len(seeds):
        return settings.epipolar_px
    beside = np.abs(epipolar_distances(template, search, seeds.pixels, seeds.there))
    usual = settings.epipolar_median_ratio * float(np.nanmedian(beside))
    return min(settings.epipolar_px, max(settings.least_epipolar_px, usual))


def merged(
    views: Sequence[SurfaceView], compared: TemplateSearch, grid: Grid, fields: Sequence[Field],
    settings: IntersectionSettings = INTERSECTION_DEFAULTS,
) -> Tuples:  # fmt: skip
    """Combine the matches of each patch in several images into one tuple.

    Args:
        views: Views of all C cameras.
        compared: The template, and the images in which it was searched.
        grid: Nodes of the template.
        fields: Matches in each of the searched images.
        settings: Number of neighbours by which the curvature is estimated.

    Returns:
        A tuple for every node with at least one match.
    """
    near = settings.bend_neighbours
    nodes = np.flatnonzero(np.any([field.found for field in fields], axis=0))
    count, cameras, here = len(nodes), len(views), compared.template
    pixels, sd = np.full((count, cameras, 2), np.nan), np.full((count, cameras), np.nan)
    bend = np.full((count, cameras, 2), np.nan)
    correlation, maps = np.full((count, cameras), np.nan), np.full((count, cameras, 2, 2), np.nan)
    size = np.zeros((count, cameras), np.int64)
    bend[:, here] = 0
    pixels[:, here], sd[:, here], correlation[:, here], maps[:, here] = grid.pixels[nodes], 0, 1, np.eye(2)
    for other, field in zip(compared.searched, fields, strict=True):
        pixels[:, other], maps[:, other] = field.there[nodes], field.maps[nodes]
        # Only the template has a correlation of exactly 1.
        correlation[:, other] = np.minimum(field.correlation[nodes], 1 - 1e-6)
        size[:, other], bend[:, other] = field.size[nodes], bends(field, grid, near)[nodes]
        sd[:, other] = _along_lines(views[here], views[other], grid.pixels[nodes], field, nodes)
    column, row = grid.pixels[nodes].astype(int).T
    return Tuples(
        template=here, grid=grid, nodes=nodes, pixels=pixels, sd=sd, bend=bend, correlation=correlation, maps=maps,
        size=size, colour=views[here].image[row, column, ::-1],
    )  # fmt: skip


def _along_lines(template: SurfaceView, search: SurfaceView, pixels: Floats, field: Field, nodes: Integers) -> Floats:
    """Return the matches' standard deviations (n,) along their epipolar lines, on which the depth depends [px]."""
    _, along = epipolar_lines(template.camera, search.camera, pixels, field.there[nodes])
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", along, field.covariance[nodes], along)))
