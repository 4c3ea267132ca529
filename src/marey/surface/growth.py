"""Growth: from its seeds, a match spreads over the template, from each found patch to the patches beside it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers, Mask, frozen
from marey.images.matching import Matches, MatchSettings, match
from marey.surface.acceptance import Limits, good, weakest_sd
from marey.surface.seeds import Seeds
from marey.surface.settings import SurfaceSettings
from marey.surface.views import View

_ATTEMPTS = 2
"""How often a patch of one size is tried, each time from another one beside it."""
_REACH = 0.8
"""How far from where its neighbour predicts it a patch may be, relative to the spacing, and ..."""
_LEAST_REACH = 1.5
"""... at least [px]."""
_AROUND = np.array([[0, -1], [0, 1], [-1, 0], [1, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]])
"""Row and column of the neighbours."""
_WIDE = 4
"""Spacing from which on a step that fails is halved [px]."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Where in the template points are measured."""

    left: int
    """x of the first column [px]."""
    top: int
    """y of the first row [px]."""
    spacing: int
    """[px]."""
    rows: int
    columns: int

    @staticmethod
    def over(view: View, *, spacing: int, half: int) -> "Grid":
        """Cover a picture as far as patches fit into it."""
        edge = half + 2
        width, height = view.camera.size
        rows, columns = (max(0, (side - 2 * edge - 1) // spacing + 1) for side in (height, width))
        left, top = ((side - 1 - (count - 1) * spacing) // 2 for side, count in ((width, columns), (height, rows)))
        return Grid(left=left, top=top, spacing=spacing, rows=rows, columns=columns)

    def __len__(self) -> int:
        """Count the nodes."""
        return self.rows * self.columns

    @cached_property
    def pixels(self) -> Floats:
        """(n, 2) the nodes, row by row [px]."""
        row, column = np.divmod(np.arange(len(self)), max(self.columns, 1))
        return np.stack([self.left + self.spacing * column, self.top + self.spacing * row], axis=-1).astype(float)

    def neighbours(self, nodes: Integers) -> Integers:
        """Give the eight nodes (m, 8) about each of some nodes; -1 beyond the border."""
        row, column = np.divmod(nodes, self.columns)
        r, c = row[:, None] + _AROUND[:, 0], column[:, None] + _AROUND[:, 1]
        inside = (r >= 0) & (r < self.rows) & (c >= 0) & (c < self.columns)
        return np.where(inside, r * self.columns + c, -1)

    def nearest(self, pixels: Floats) -> Integers:
        """Give the node nearest to each pixel (n, 2)."""
        place = np.round((pixels - [self.left, self.top]) / self.spacing).astype(int)
        column, row = np.clip(place, 0, [self.columns - 1, self.rows - 1]).T
        return row * self.columns + column


@dataclass(frozen=True, eq=False, kw_only=True)
class Field:
    """What was found of a template in one search picture, node by node; NaN where nothing was."""

    there: Floats
    """(n, 2) [px]."""
    maps: Floats
    """(n, 2, 2)."""
    covariance: Floats
    """(n, 2, 2) [px2]."""
    correlation: Floats
    """(n,)."""
    size: Integers
    """(n,) of the patch [px]; 0 where nothing was found."""

    def __post_init__(self) -> None:
        for name in ("there", "maps", "covariance", "correlation"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        object.__setattr__(self, "size", frozen(self.size, np.int64))

    @property
    def found(self) -> Mask:
        """(n,) where something was found."""
        return self.size > 0

    def only(self, kept: Mask) -> "Field":
        """Forget all but some nodes (n,)."""
        pick = lambda values: np.where(kept.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)  # noqa: E731
        return Field(
            there=pick(self.there), maps=pick(self.maps), covariance=pick(self.covariance),
            correlation=pick(self.correlation), size=np.where(kept, self.size, 0),
        )  # fmt: skip


def grow(template: View, search: View, grid: Grid, seeds: Seeds, limits: Limits, settings: SurfaceSettings) -> Field:
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
        limits: Which matches are believed.
        settings: Sizes of the patches.

    Returns:
        What was found.
    """
    wave = _Wave(template, search, grid, limits)
    if not len(seeds) or not len(grid):
        return wave.field()
    region = cKDTree(seeds.pixels).query(grid.pixels)[1]
    for size in settings.sizes:
        wave.begin(size)
        if size == settings.patch:
            wave.sow(seeds)
            wave.spread(region)
        wave.spread(None)
    return wave.field()


class _Wave:
    """A match that is spreading."""

    def __init__(self, template: View, search: View, grid: Grid, limits: Limits):
        self._views, self._grid, self._limits = (template, search), grid, limits
        count = len(grid)
        self._there, self._maps = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
        self._covariance, self._correlation = np.full((count, 2, 2), np.nan), np.full(count, np.nan)
        self._size, self._tries = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self._sd = np.full(count + 1, np.inf)
        """The last number belongs to no node, and is what neighbours beyond the border have."""
        self._allowed = np.append(template.shows(grid.pixels), False)
        self._settings = MatchSettings()

    def begin(self, size: int) -> None:
        """Go on with patches of another size."""
        reach = max(_LEAST_REACH, _REACH * self._grid.spacing)
        self._settings = MatchSettings(size=size, noise=self._views[0].noise, reach=reach)
        self._tries[:] = 0

    def sow(self, seeds: Seeds) -> None:
        """Match the node nearest to each seed."""
        nodes, which = np.unique(self._grid.nearest(seeds.pixels), return_index=True)
        allowed = self._allowed[nodes]
        nodes, which = nodes[allowed], which[allowed]
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

    def field(self) -> Field:
        """Give what was found."""
        return Field(
            there=self._there, maps=self._maps, covariance=self._covariance, correlation=self._correlation,
            size=self._size,
        )  # fmt: skip
