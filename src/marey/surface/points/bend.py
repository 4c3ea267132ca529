"""Displacement of matches by the curvature of the surface, estimated from the variation of neighbouring affine maps.

A patch's affine map is the best one over all its pixels. On a curved surface, points within the patch deviate from that
map by half their second derivatives, and the centre by the mean of this: 0.1 px and more for large patches on limbs.
All views see the same curvature, so that the rays still intersect and the residuals do not show it.
"""

import numpy as np

from marey.arrays import Floats
from marey.compiled.kernels import kernel
from marey.surface.points.field import Field, Grid
from marey.surface.points.settings import INTERSECTION_DEFAULTS


def bends(field: Field, grid: Grid, most: int = INTERSECTION_DEFAULTS.bend_neighbours) -> Floats:
    """Estimate the displacement of each match of a field by the curvature of the surface.

    Ours. In the neighbourhood that a patch covers, planes are fitted to the elements of the matches' maps. With the
    slopes a_x and b_y of the map's first row (a, b), and M the mean of x squared over the patch, its centre is
    displaced by M (a_x + b_y) / 2 in x, and likewise in y.

    Args:
        field: The matches.
        grid: The nodes of the field.
        most: Largest number of neighbours used on each side, distributed over the patch.

    Returns:
        (n, 2) displacements [px]; NaN without a match, 0 along directions without neighbours.
    """
    drawn = np.full((len(grid), 2), np.nan)
    maps = np.ascontiguousarray(field.maps.reshape(len(grid), 4))
    size = np.ascontiguousarray(field.size)
    _bends(maps, size, grid.rows, grid.columns, float(grid.spacing), most, drawn)
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
        # This makes the slope zero in directions without neighbours.
        least = 1e-6 * spacing * spacing
        normal[1, 1] += least
        normal[2, 2] += least
        mean = half * (half + 1) / 3.0
        drawn[node, 0], drawn[node, 1] = _slope_sums(normal, right)
        drawn[node, 0] *= 0.5 * mean
        drawn[node, 1] *= 0.5 * mean


@kernel
def _slope_sums(normal, right):
    """Return slope of value 0 in x plus that of value 1 in y, and that of 2 in x plus that of 3 in y."""
    # The mean of the values is eliminated first.
    x, y = normal[0, 1] / normal[0, 0], normal[0, 2] / normal[0, 0]
    xx, xy = normal[1, 1] - x * normal[0, 1], normal[1, 2] - x * normal[0, 2]
    yy = normal[2, 2] - y * normal[0, 2]
    determinant = xx * yy - xy * xy
    a, b = right[1, 0] - x * right[0, 0], right[2, 0] - y * right[0, 0]
    c, d = right[1, 1] - x * right[0, 1], right[2, 1] - y * right[0, 1]
    first = (yy * a - xy * b + xx * d - xy * c) / determinant
    a, b = right[1, 2] - x * right[0, 2], right[2, 2] - y * right[0, 2]
    c, d = right[1, 3] - x * right[0, 3], right[2, 3] - y * right[0, 3]
    return first, (yy * a - xy * b + xx * d - xy * c) / determinant


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
