"""Growth: from its seeds, a match spreads over the template, from each found patch to the patches beside it."""

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers, Mask
from marey.images.matching.matching import Matches, MatchSettings, match
from marey.surface.points.acceptance import Limits, good, weakest_sd
from marey.surface.points.checks import continuous
from marey.surface.points.field import Field, Grid
from marey.surface.points.seeds import Seeds
from marey.surface.points.settings import Pass, SurfaceSettings
from marey.surface.points.views import SurfaceView

_ATTEMPTS = 1
"""How often a patch of one size is tried."""
_STEPS = 15
"""Most steps of a match: a start beside a good neighbour takes three or four, more where texture is weak."""
_PRECISION = 0.04
"""The last step's size [px]; what is left after it is a tenth of it and less."""
_REACH = 0.8
"""How far from where its neighbour predicts it a patch may be, relative to the spacing, and ..."""
_LEAST_REACH = 1.5
"""... at least [px]."""
_WIDE = 4
"""Spacing from which on a step that fails is halved [px]."""


def grow(
    template: SurfaceView,
    search: SurfaceView,
    grid: Grid,
    seeds: Seeds,
    settings: SurfaceSettings,
    *,
    epipolar_px: float,
) -> Field:
    """Spread matches over the template ([Plaenkers1999] section 2.1).

    Each seed's Voronoi region is covered from the seed, by patches that begin where the patch beside them predicts
    them, place and affine map; then holes are closed from all sides across the regions' borders, and last with larger
    patches. Unlike the paper, all patches at the rim of what is found are matched at once, and of those beside it a
    patch begins from the most certain.

    Args:
        template: The view of which patches are taken.
        search: The view in which they are looked for.
        grid: The patches' centres.
        seeds: Where to begin.
        settings: Sizes of the patches, and which matches are believed.
        epipolar_px: How far from its epipolar line a match may lie [px].

    Returns:
        What was found.
    """
    wave = _Wave(template, search, grid)
    if not len(seeds) or not len(grid):
        return wave.field()
    region = cKDTree(seeds.pixels).query(grid.pixels)[1]
    for number, way in enumerate(settings.passes):
        wave.begin(way, epipolar_px)
        wave.sow(seeds)
        if number == 0:
            wave.spread(region)
        wave.spread(None)
        wave.prune()
    return wave.field()


class _Wave:
    """A match that is spreading."""

    def __init__(self, template: SurfaceView, search: SurfaceView, grid: Grid):
        self._views, self._grid = (template, search), grid
        count = len(grid)
        self._there, self._maps = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
        self._covariance, self._correlation = np.full((count, 2, 2), np.nan), np.full(count, np.nan)
        self._size, self._tries = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self._sd = np.full(count + 1, np.inf)
        """The last number belongs to no node, and is what neighbours beyond the border have."""
        self._allowed = np.append(template.shows(grid.pixels), False)

    def begin(self, way: Pass, epipolar_px: float) -> None:
        """Go on in another way."""
        self._limits = Limits(correlation=way.correlation, sd_px=way.sd_px, epipolar_px=epipolar_px)
        reach = max(_LEAST_REACH, _REACH * self._grid.spacing)
        self._settings = MatchSettings(
            size=way.size, noise=self._views[0].noise, reach=reach, steps=_STEPS, precision=_PRECISION
        )
        self._tries[:] = 0

    def sow(self, seeds: Seeds) -> None:
        """Match the node nearest to each seed, where nothing is found yet."""
        nodes, which = np.unique(self._grid.nearest(seeds.pixels), return_index=True)
        wanted = self._allowed[nodes] & (self._size[nodes] == 0)
        nodes, which = nodes[wanted], which[wanted]
        self._attempt(nodes, seeds.pixels[which], seeds.there[which], seeds.maps[which])

    def spread(self, region: Integers | None) -> None:
        """Go from all that is found to what lies beside it, until nothing more is found.

        Args:
            region: (n,) only within the same region; None to go everywhere.
        """
        front = np.flatnonzero(self._size)
        while len(front):
            nodes, origins = self._candidates(front, region)
            front = self._attempt(nodes, self._grid.pixels[origins], self._there[origins], self._maps[origins])

    def _candidates(self, front: Integers, region: Integers | None) -> tuple[Integers, Integers]:
        """List nodes beside the front that may be tried, each with its most certain neighbour."""
        nodes = np.unique(self._grid.neighbours(front))
        nodes = nodes[(nodes >= 0) & self._allowed[nodes]]
        nodes = nodes[(self._size[nodes] == 0) & (self._tries[nodes] < _ATTEMPTS)]
        beside = self._grid.neighbours(nodes)
        certain = self._sd[beside]
        if region is not None:
            certain = np.where(region[beside] == region[nodes][:, None], certain, np.inf)
        best = certain.argmin(axis=1)
        row = np.arange(len(nodes))
        usable = np.isfinite(certain[row, best])
        return nodes[usable], beside[row, best][usable]

    def _attempt(self, nodes: Integers, pixels: Floats, there: Floats, maps: Floats) -> Integers:
        """Match nodes from what is known at pixels beside them; give those that were found."""
        self._tries[nodes] += 1
        kept = self._keep(nodes, self._match(self._grid.pixels[nodes], pixels, there, maps))
        if self._grid.spacing < _WIDE or kept.all():
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
        fine = good(*self._views, self._grid.pixels[nodes], found, self._limits)
        kept = nodes[fine]
        self._there[kept], self._maps[kept] = found.pixels[fine], found.search_from_template[fine]
        self._covariance[kept], self._correlation[kept] = found.covariance[fine], found.correlation[fine]
        self._size[kept] = self._settings.size
        self._sd[kept] = weakest_sd(found.covariance[fine])
        return fine

    def prune(self) -> None:
        """Forget what the patches beside it contradict, so that larger patches may try again."""
        lost = (self._size > 0) & ~continuous(self.field(), self._grid, self._sd[:-1]).found
        for values in (self._there, self._maps, self._covariance, self._correlation):
            values[lost] = np.nan
        self._size[lost] = 0
        self._sd[:-1][lost] = np.inf

    def field(self) -> Field:
        """Give what was found."""
        return Field(
            there=self._there, maps=self._maps, covariance=self._covariance, correlation=self._correlation,
            size=self._size,
        )  # fmt: skip
