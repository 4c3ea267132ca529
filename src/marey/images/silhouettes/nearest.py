"""Nearest-pixel search: pixels are sorted into square cells, and only the cells around a position are searched."""

from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers
from marey.compiled.kernels import kernel

CELL = 6
"""Width of a cell [px], slightly more than the usual distance between matched outlines. Chosen by hand."""


class Cells(NamedTuple):
    """Pixels sorted into cells."""

    pixels: Floats
    """(n, 2) x, y."""
    left: int
    """x of the first cell's corner."""
    top: int
    rows: int
    columns: int
    first: Integers
    """(rows columns + 1,) index of each cell's first pixel in `order`."""
    order: Integers
    """(n,) indices of the pixels, cell by cell."""


@kernel
def sort_into_cells(pixels):
    """Sort pixels (n, 2) into `Cells`."""
    count = pixels.shape[0]
    left = top = right = bottom = 0
    for i in range(count):
        x, y = int(np.floor(pixels[i, 0])), int(np.floor(pixels[i, 1]))
        left, right = (x, x) if i == 0 else (min(left, x), max(right, x))
        top, bottom = (y, y) if i == 0 else (min(top, y), max(bottom, y))
    rows, columns = (bottom - top) // CELL + 1, (right - left) // CELL + 1
    cell = np.empty(count, np.int64)
    first = np.zeros(rows * columns + 1, np.int64)
    for i in range(count):
        x, y = int(np.floor(pixels[i, 0])), int(np.floor(pixels[i, 1]))
        cell[i] = (y - top) // CELL * columns + (x - left) // CELL
        first[cell[i] + 1] += 1
    for c in range(rows * columns):
        first[c + 1] += first[c]
    place = first[:-1].copy()
    order = np.empty(count, np.int64)
    for i in range(count):
        order[place[cell[i]]] = i
        place[cell[i]] += 1
    return Cells(pixels, left, top, rows, columns, first, order)


@kernel
def nearest_within(cells, x, y, reach):
    """Return the index of the pixel nearest to a position; -1 if none is within reach [px]."""
    row, column = int(np.floor(y - cells.top)) // CELL, int(np.floor(x - cells.left)) // CELL
    # Distance to the nearest side of the own cell.
    across, down = x - cells.left - column * CELL, y - cells.top - row * CELL
    inside = min(min(across, CELL - across), min(down, CELL - down))
    best, found = reach * reach, -1
    ring = 0
    while True:
        left, right = min(max(column - ring, 0), cells.columns), max(min(column + ring + 1, cells.columns), 0)
        for r in range(max(row - ring, 0), min(row + ring + 1, cells.rows)):
            # Pixels in rows of other cells are at least this far away.
            gap = down + (row - r - 1) * CELL if r < row else (r - row) * CELL - down
            if r != row and gap * gap > best:
                continue
            # Successive cells; those of inner rings, which were searched before, change nothing.
            for k in range(cells.first[r * cells.columns + left], cells.first[r * cells.columns + right]):
                i = cells.order[k]
                dx, dy = cells.pixels[i, 0] - x, cells.pixels[i, 1] - y
                distance = dx * dx + dy * dy
                if distance < best or (distance == best and found < 0):
                    best, found = distance, i
        # Pixels in outer rings are at least this far away.
        if best <= (ring * CELL + inside) ** 2:
            return found
        ring += 1


@kernel
def nearest_other(cells, label, found, x, y, reach, slack):
    """Return the index of the pixel nearest to a position among those with another label than the nearest of all.

    Args:
        cells: `Cells` of n pixels.
        label: (n,) label of each pixel.
        found: Index of the nearest pixel of all.
        x: x of the position [px].
        y: y of the position [px].
        reach: Largest distance [px].
        slack: Largest additional distance relative to the nearest pixel of all [px].

    Returns:
        An index; -1 if there is none.
    """
    dx, dy = cells.pixels[found, 0] - x, cells.pixels[found, 1] - y
    limit = min(np.sqrt(dx * dx + dy * dy) + slack, reach)
    best, other = limit * limit, -1
    top, bottom = int(np.floor(y - limit - cells.top)) // CELL, int(np.floor(y + limit - cells.top)) // CELL
    left, right = int(np.floor(x - limit - cells.left)) // CELL, int(np.floor(x + limit - cells.left)) // CELL
    for row in range(max(top, 0), min(bottom + 1, cells.rows)):
        for column in range(max(left, 0), min(right + 1, cells.columns)):
            cell = row * cells.columns + column
            for k in range(cells.first[cell], cells.first[cell + 1]):
                i = cells.order[k]
                if label[i] == label[found]:
                    continue
                dx, dy = cells.pixels[i, 0] - x, cells.pixels[i, 1] - y
                distance = dx * dx + dy * dy
                if distance <= best:
                    best, other = distance, i
    return other
