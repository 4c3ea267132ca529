"""By how much a bent surface draws patches aside, which no affine map follows: told by how maps change about them.

A patch's affine map is the best one over all its pixels. Where the surface is bent, places within the patch lie off
that map by half their second derivatives, and the middle by the mean of that: 0.1 px and more where large patches lie
on round limbs. All views see the same bend, so that rays go on meeting and no residual shows it.
"""

import numpy as np

from marey.arrays import Floats
from marey.kernels import kernel
from marey.surface.points.field import Field, Grid

_MOST = 3
"""Neighbours to each side that are looked at, spread over the patch."""


def bends(field: Field, grid: Grid) -> Floats:
    """Say by how much the surface's bend may draw each match of a field aside.

    Ours. In the neighbourhood that a patch covers, the elements of the matches' maps are fitted by planes; with the
    slopes a_x and b_y of the map's first row (a, b) and M the mean of x squared over the patch, its middle is drawn
    aside by M (a_x + b_y) / 2 across, and likewise down.

    Args:
        field: What was found.
        grid: Its nodes.

    Returns:
        (n, 2) [px]; NaN where nothing was found, 0 along directions in which no neighbour tells.
    """
    drawn = np.full((len(grid), 2), np.nan)
    maps = np.ascontiguousarray(field.maps.reshape(len(grid), 4))
    size = np.ascontiguousarray(field.size)
    _bends(maps, size, grid.rows, grid.columns, float(grid.spacing), _MOST, drawn)
    return drawn


@kernel
def _bends(maps, sizes, rows, columns, spacing, most, drawn):
    normal, right = np.empty((3, 3)), np.empty((3, 4))
    for node in range(rows * columns):
        if sizes[node] == 0:
            continue
        row, column, half = node // columns, node % columns, sizes[node] // 2
        reach = max(1, round(half / spacing))
        stride = max(1, reach // most)
        reach = stride * (reach // stride)
        normal[:] = 0.0
        right[:] = 0.0
        for i in range(max(row % stride, row - reach), min(rows, row + reach + 1), stride):
            for j in range(max(column % stride, column - reach), min(columns, column + reach + 1), stride):
                other = i * columns + j
                if sizes[other] > 0:
                    _add(normal, right, (j - column) * spacing, (i - row) * spacing, maps[other])
        # In a direction in which no neighbour lies this makes the slope nothing.
        least = 1e-6 * spacing * spacing
        normal[1, 1] += least
        normal[2, 2] += least
        slopes = np.linalg.solve(normal, right)
        mean = half * (half + 1) / 3.0
        drawn[node, 0] = 0.5 * mean * (slopes[1, 0] + slopes[2, 1])
        drawn[node, 1] = 0.5 * mean * (slopes[1, 2] + slopes[2, 3])


@kernel
def _add(normal, right, x, y, values):
    """Add an observation of planes over (1, x, y) to normal equations."""
    normal[0, 0] += 1.0
    normal[0, 1] += x
    normal[1, 0] += x
    normal[0, 2] += y
    normal[2, 0] += y
    normal[1, 1] += x * x
    normal[1, 2] += x * y
    normal[2, 1] += x * y
    normal[2, 2] += y * y
    for k in range(values.shape[0]):
        right[0, k] += values[k]
        right[1, k] += x * values[k]
        right[2, k] += y * values[k]
