"""Dense measurement of a surface in the pictures of one instant: from seeds to tuples of matches."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Image, Integers, freeze_fields
from marey.cameras.epipolar import epipolar_lines
from marey.surface.points.acceptance import beside_lines
from marey.surface.points.bend import bends
from marey.surface.points.field import Field, Grid
from marey.surface.points.growth import grow
from marey.surface.points.seeds import Seeds, find_seeds
from marey.surface.points.settings import SurfaceSettings
from marey.surface.points.views import SurfaceView, TemplateSearch

_LEAST_EPIPOLAR = 0.5
"""Limits on epipolar distances are no tighter [px]."""
_USUAL = 4.0
"""A distance is usual up to so many times the median."""

GivenSeeds = Mapping[tuple[int, int], Seeds]
"""Seeds known beforehand, for a template's camera and a searched one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tuples:
    """What belongs together: nodes of one template with their matches in the other pictures."""

    template: int
    """The template's camera, of C."""
    grid: Grid
    nodes: Integers
    """(n,) of the grid."""
    pixels: Floats
    """(n, C, 2) [px]; NaN without a match."""
    sd: Floats
    """(n, C) standard deviation of the match, along the epipolar line [px]; 0 in the template."""
    bend: Floats
    """(n, C, 2) by how much the surface's bend may draw the match aside [px]; 0 in the template."""
    correlation: Floats
    """(n, C), 1 in the template."""
    maps: Floats
    """(n, C, 2, 2) affine maps from the template's patches."""
    size: Integers
    """(n, C) of the patches [px]."""
    colour: Image
    """(n, 3) red, green, blue of the template."""

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
    """Match a template densely in other pictures, each for itself, and put together what belongs to the same patch.

    Args:
        views: All C cameras' views of an instant.
        compared: The template, and where it is looked for.
        settings: Spacing, patches, and limits.
        given: Seeds that are known beforehand; others are found besides.
        threads: Search pictures that are worked on at once.

    Returns:
        The tuples; none where no seed was found.
    """
    template, searched = views[compared.template], [views[i] for i in compared.searched]
    grid = Grid.over(template, spacing=settings.spacing, half=settings.patch // 2)
    seeds = list(find_seeds(template, searched, settings, threads=threads))
    for k, other in enumerate(compared.searched):
        known = (given or {}).get((compared.template, other))
        seeds[k] = seeds[k] if known is None else seeds[k].and_also(known)

    def work(search: SurfaceView, start: Seeds) -> Field:
        limit = _epipolar_limit(template, search, start, settings)
        return grow(template, search, grid, start, settings, epipolar_px=limit)

    with ThreadPoolExecutor(max(1, min(threads, len(searched)))) as pool:
        fields = list(pool.map(work, searched, seeds))
    return merged(views, compared, grid, fields)


def _epipolar_limit(template: SurfaceView, search: SurfaceView, seeds: Seeds, settings: SurfaceSettings) -> float:
    """Say how far matches may lie beside their lines, from how far the seeds lie [px]."""
    if not len(seeds):
        return settings.epipolar_px
    beside = np.abs(beside_lines(template, search, seeds.pixels, seeds.there))
    return min(settings.epipolar_px, max(_LEAST_EPIPOLAR, 2 * _USUAL * float(np.nanmedian(beside))))


def merged(views: Sequence[SurfaceView], compared: TemplateSearch, grid: Grid, fields: Sequence[Field]) -> Tuples:
    """Put what was found of the same patch in several pictures into one tuple.

    Args:
        views: All C cameras' views.
        compared: The template, and where it was looked for.
        grid: The template's nodes.
        fields: What was found in each of the searched pictures.

    Returns:
        A tuple for every node that was found somewhere.
    """
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
        # Exactly 1 is the template's alone.
        correlation[:, other] = np.minimum(field.correlation[nodes], 1 - 1e-6)
        size[:, other], bend[:, other] = field.size[nodes], bends(field, grid)[nodes]
        sd[:, other] = _along_lines(views[here], views[other], grid.pixels[nodes], field, nodes)
    column, row = grid.pixels[nodes].astype(int).T
    return Tuples(
        template=here, grid=grid, nodes=nodes, pixels=pixels, sd=sd, bend=bend, correlation=correlation, maps=maps,
        size=size, colour=views[here].image[row, column, ::-1],
    )  # fmt: skip


def _along_lines(template: SurfaceView, search: SurfaceView, pixels: Floats, field: Field, nodes: Integers) -> Floats:
    """Give the matches' standard deviations (n,) along their epipolar lines, which is what depth depends on [px]."""
    _, along = epipolar_lines(template.camera, search.camera, pixels, field.there[nodes])
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", along, field.covariance[nodes], along)))
