"""Values at the vertices of a surface: smoothing, and the smoothest choice among candidates."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from marey.arrays import Floats, Integers, Mask
from marey.compiled.kernels import kernel
from marey.knee.space.surface import TriangleSurface

_ROUNDS, _DAMPING = 30, 0.3
"""Rounds of belief propagation, and the share of each message that is kept from the round before; chosen by hand."""


@dataclass(frozen=True, eq=False)
class MeshGraph:
    """The edges between a surface's vertices."""

    edges: Integers
    """(E, 2) each edge once."""
    lengths_mm: Floats
    """(E,)."""
    count: int
    """V."""

    @staticmethod
    def of(surface: TriangleSurface) -> "MeshGraph":
        """Collect the edges of a surface."""
        every = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges = np.unique(every, axis=0)
        ends = surface.vertices_mm[edges]
        return MeshGraph(edges, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), len(surface.vertices_mm))

    @cached_property
    def _mean(self) -> sparse.csr_matrix:
        """Matrix that replaces each vertex' value by half of it and half of its neighbours' mean."""
        first, second = self.edges.T
        ones = np.ones(2 * len(self.edges))
        rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
        beside = sparse.csr_matrix((ones, (rows, columns)), shape=(self.count, self.count))
        number = np.maximum(np.asarray(beside.sum(1)).ravel(), 1.0)
        return 0.5 * (sparse.identity(self.count, format="csr") + sparse.diags(1 / number) @ beside)

    def smoothed(self, values: Floats, width_mm: float) -> Floats:
        """Smooth values (V,) or (V, n) over the surface by diffusion, to about a standard deviation in mm."""
        step = (
            0.5 * float(np.mean(self.lengths_mm**2)) / 2
        )  # mean squared displacement of half a step, along one direction
        out = np.asarray(values, float)
        for _ in range(max(int(np.ceil(width_mm**2 / max(step, 1e-9))), 1)):
            out = self._mean @ out
        return out

    def filled(self, values: Floats, weights: Floats, width_mm: float) -> Floats:
        """Return the weighted mean of values (V,) about each vertex; NaN where no weight is near."""
        both = self.smoothed(np.stack([np.where(weights > 0, values, 0.0) * weights, weights], 1), width_mm)
        return np.asarray(np.divide(both[:, 0], both[:, 1], out=np.full(self.count, np.nan), where=both[:, 1] > 1e-9))

    def slopes(self, values: Floats, used: Mask) -> Floats:
        """Return the root mean square of the slopes of values (V,) along the edges at each vertex, per mm.

        Only edges between used vertices count; a vertex without such an edge has slope 0. The slope of the surface is
        the square root of two times as large, because an edge has any direction.
        """
        kept = used[self.edges].all(1)
        first, second = self.edges[kept].T
        squares = ((values[second] - values[first]) / np.maximum(self.lengths_mm[kept], 1e-9)) ** 2
        ends, twice = np.concatenate([first, second]), np.concatenate([squares, squares])
        number = np.maximum(np.bincount(ends, minlength=self.count), 1)
        return np.asarray(np.sqrt(np.bincount(ends, twice, self.count) / number))

    def pieces(self, mask: Mask) -> Integers:
        """Number the pieces (V,) of a mask, from 0; -1 outside the mask."""
        kept = self.edges[mask[self.edges].all(1)]
        links = sparse.coo_matrix((np.ones(len(kept)), (kept[:, 0], kept[:, 1])), shape=(self.count, self.count))
        piece = sparse.csgraph.connected_components(links, directed=False)[1]
        numbers = np.full(self.count, -1)
        numbers[mask] = np.unique(piece[mask], return_inverse=True)[1]
        return numbers

    def choose(self, costs: Floats, levels_mm: Floats, slope_sd: float, most: float) -> Floats:
        """Choose among candidates at each vertex so that neighbours agree, by min-sum belief propagation.

        Args:
            costs: (V, L) cost of each candidate alone: half a squared residual.
            levels_mm: (L,) the candidates, increasing, the same at all vertices.
            slope_sd: Standard deviation of their slope over the surface [mm/mm].
            most: Largest cost of a pair of neighbours.

        Returns:
            (V, L) approximate least total cost when a vertex takes each candidate; the least of each vertex is 0.
        """
        sd = slope_sd * np.maximum(self.lengths_mm, 0.2)
        beliefs = _beliefs(
            np.ascontiguousarray(costs, float), np.asarray(levels_mm, float), np.ascontiguousarray(self.edges),
            0.5 / sd**2, float(most), _ROUNDS, _DAMPING,
        )  # fmt: skip
        return np.asarray(beliefs - beliefs.min(1, keepdims=True))


@kernel
def _beliefs(costs, levels, edges, stiffness, most, rounds, damping):  # pragma: no cover - compiled
    """Pass messages; message 2 e + b is sent from end b of edge e to its other end."""
    number = costs.shape[1]
    messages = np.zeros((2 * len(edges), number))
    beliefs = costs.copy()
    ready = np.empty(number)
    for _round in range(rounds):
        for e in range(len(edges)):
            for b in range(2):
                sender = edges[e, b]
                least = np.inf
                for n in range(number):
                    ready[n] = beliefs[sender, n] - messages[2 * e + 1 - b, n]
                    least = min(least, ready[n])
                target = edges[e, 1 - b]
                for m in range(number):
                    best = least + most
                    # Levels increase: beyond the first one that is too far, all are.
                    for n in range(m, -1, -1):
                        step = stiffness[e] * (levels[m] - levels[n]) ** 2
                        if step >= most:
                            break
                        best = min(best, ready[n] + step)
                    for n in range(m + 1, number):
                        step = stiffness[e] * (levels[m] - levels[n]) ** 2
                        if step >= most:
                            break
                        best = min(best, ready[n] + step)
                    new = damping * messages[2 * e + b, m] + (1.0 - damping) * (best - least)
                    beliefs[target, m] += new - messages[2 * e + b, m]
                    messages[2 * e + b, m] = new
    return beliefs
