"""Region growing: matches spread from seeds over the template, from each matched patch to its neighbours."""

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers, Mask
from marey.compiled.kernels import kernel
from marey.images.matching.matching import Matches, MatchSettings, match
from marey.surface.points.acceptance import MatchLimits, accepted, weakest_sd
from marey.surface.points.checks import continuous
from marey.surface.points.field import AROUND, Field, Grid
from marey.surface.points.seeds import Seeds
from marey.surface.points.settings import Pass, SurfaceSettings
from marey.surface.points.views import SurfaceView


def grow(
    template: SurfaceView,
    search: SurfaceView,
    grid: Grid,
    seeds: Seeds,
    settings: SurfaceSettings,
    *,
    epipolar_px: float,
) -> Field:
    """Grow matches over the template ([Plaenkers1999] section 2.1).

    The Voronoi region of each seed is covered from the seed: a patch starts with the position and affine map that its
    neighbour predicts. Then holes are closed from all sides across the regions' borders, and last with larger patches.
    Unlike the paper, all patches at the front are matched at once, each from its neighbour with the smallest standard
    deviation.

    Args:
        template: The view from which patches are taken.
        search: The view in which they are searched.
        grid: Centres of the patches.
        seeds: Matches from which the growth starts.
        settings: Sizes of the patches, and thresholds for matches.
        epipolar_px: Largest distance of a match from its epipolar line [px].

    Returns:
        The matches.
    """
    wave = _Wave(template, search, grid, settings)
    if not len(seeds) or not len(grid):
        return wave.field()
    region = wave.regions(seeds)
    for number, way in enumerate(settings.passes):
        wave.begin(way, epipolar_px)
        wave.sow(seeds)
        if number == 0:
            wave.spread(region)
        wave.spread(None)
        wave.prune()
    return wave.field()


class _Wave:
    """State of a growing field of matches."""

    def __init__(self, template: SurfaceView, search: SurfaceView, grid: Grid, settings: SurfaceSettings):
        self._growth, self._checks = settings.growth, settings.checks
        self._views, self._grid = (template, search), grid
        count = len(grid)
        self._there, self._maps = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
        self._covariance, self._correlation = np.full((count, 2, 2), np.nan), np.full(count, np.nan)
        self._size, self._tries = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self._sd, self._allowed = np.full(count, np.inf), template.shows(grid.pixels)
        self._waiting = np.zeros(count, bool)

    def regions(self, seeds: Seeds) -> Integers:
        """Return the number of the nearest seed (n,) of each node that may be matched; 0 for the others."""
        region, nodes = np.zeros(len(self._grid), np.int64), np.flatnonzero(self._allowed)
        region[nodes] = cKDTree(seeds.pixels).query(self._grid.pixels[nodes])[1]
        return region

    def begin(self, way: Pass, epipolar_px: float) -> None:
        """Start another pass."""
        self._limits = MatchLimits(correlation=way.correlation, sd_px=way.sd_px, epipolar_px=epipolar_px)
        growth = self._growth
        reach = max(growth.least_reach_px, growth.reach_ratio * self._grid.spacing)
        self._settings = MatchSettings(
            size=way.size, noise=self._views[0].noise, reach=reach, steps=growth.steps, precision=growth.precision_px,
        )  # fmt: skip
        self._tries[:] = 0
        self._waiting = self._allowed & (self._size == 0)

    def sow(self, seeds: Seeds) -> None:
        """Match the node nearest to each seed, if it has no match yet."""
        nodes, which = np.unique(self._grid.nearest(seeds.pixels), return_index=True)
        wanted = self._waiting[nodes]
        nodes, which = nodes[wanted], which[wanted]
        self._attempt(nodes, seeds.pixels[which], seeds.there[which], seeds.maps[which])

    def spread(self, region: Integers | None) -> None:
        """Grow from all matched nodes to their neighbours, until no further match is found.

        Args:
            region: (n,) regions within which matches grow; None for no restriction.
        """
        front = np.flatnonzero(self._size)
        while len(front):
            nodes, origins = beside_front(front, self._waiting, self._sd, region, self._grid)
            front = self._attempt(nodes, self._grid.pixels[origins], self._there[origins], self._maps[origins])

    def _attempt(self, nodes: Integers, pixels: Floats, there: Floats, maps: Floats) -> Integers:
        """Match nodes, starting from the matches of neighbouring pixels; return those that were found."""
        self._tries[nodes] += 1
        self._waiting[nodes] = self._tries[nodes] < self._growth.attempts
        kept = self._keep(nodes, self._match(self._grid.pixels[nodes], pixels, there, maps))
        if self._grid.spacing < self._growth.halved_spacing_px or kept.all():
            return nodes[kept]
        left = ~kept
        half_way = 0.5 * (self._grid.pixels[nodes[left]] + pixels[left])
        between = self._match(half_way, pixels[left], there[left], maps[left])
        again = self._match(
            self._grid.pixels[nodes[left]], half_way, between.pixels, between.search_from_template
        )  # fmt: skip
        kept[left] = self._keep(nodes[left], again)
        return nodes[kept]

    def _match(self, wanted: Floats, pixels: Floats, there: Floats, maps: Floats) -> Matches:
        starts = there + np.einsum("nij,nj->ni", maps, wanted - pixels)
        template, search = self._views
        return match(template.spline, search.spline, wanted, starts, maps=maps, settings=self._settings)

    def _keep(self, nodes: Integers, found: Matches) -> Mask:
        fine = accepted(*self._views, self._grid.pixels[nodes], found, self._limits)
        kept = nodes[fine]
        self._there[kept], self._maps[kept] = found.pixels[fine], found.search_from_template[fine]
        self._covariance[kept], self._correlation[kept] = found.covariance[fine], found.correlation[fine]
        self._size[kept], self._waiting[kept] = self._settings.size, False
        self._sd[kept] = weakest_sd(found.covariance[fine])
        return fine

    def prune(self) -> None:
        """Remove matches that their neighbours contradict, so that larger patches are tried there."""
        found = self._size > 0
        lost = found & ~continuous(self._there, self._maps, found, self._grid, self._sd, self._checks)
        for values in (self._there, self._maps, self._covariance, self._correlation):
            values[lost] = np.nan
        self._size[lost] = 0
        self._sd[lost] = np.inf

    def field(self) -> Field:
        """Return the matches."""
        return Field(
            there=self._there, maps=self._maps, covariance=self._covariance, correlation=self._correlation,
            size=self._size,
        )  # fmt: skip


def beside_front(
    front: Integers, waiting: Mask, sd: Floats, region: Integers | None, grid: Grid
) -> tuple[Integers, Integers]:
    """Find the waiting nodes beside a front, each with its neighbour of the smallest standard deviation.

    Args:
        front: (m,) nodes.
        waiting: (n,) which nodes may be found.
        sd: (n,) standard deviation of each match; infinite without a match.
        region: (n,) regions, whose nodes have neighbours of the same region only; None for no restriction.
        grid: The n nodes.

    Returns:
        Nodes (k,) in ascending order, and their neighbours (k,).
    """
    within = np.zeros(0, np.int64) if region is None else region
    nodes, origins = np.empty(8 * len(front), np.int64), np.empty(8 * len(front), np.int64)
    count = _find_beside(front, waiting, sd, within, grid.rows, grid.columns, nodes, origins)
    order = np.argsort(nodes[:count])
    return nodes[order], origins[order]


@kernel
def _find_beside(front, waiting, sd, region, rows, columns, nodes, origins):
    """Write each waiting node beside the front once, with its origin; return the number of nodes."""
    count = 0
    for node in front:
        row, column = node // columns, node % columns
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(column - 1, 0), min(column + 2, columns)):
                other = i * columns + j
                if waiting[other]:
                    # A node that is listed does not wait until the list is complete.
                    waiting[other] = False
                    nodes[count] = other
                    count += 1
    usable = 0
    for k in range(count):
        node = nodes[k]
        waiting[node] = True
        best = _most_precise(node, sd, region, rows, columns)
        if best >= 0:
            nodes[usable], origins[usable] = node, best
            usable += 1
    return usable


@kernel
def _most_precise(node, sd, region, rows, columns):
    """Return the neighbour with the smallest standard deviation; -1 without a match beside the node.

    An empty `region` is no restriction.
    """
    row, column, best, least = node // columns, node % columns, -1, np.inf
    for k in range(8):
        i, j = row + AROUND[k, 0], column + AROUND[k, 1]
        if 0 <= i < rows and 0 <= j < columns:
            other = i * columns + j
            if sd[other] < least and (len(region) == 0 or region[other] == region[node]):
                best, least = other, sd[other]
    return best
