"""Compiled kernels of `marey.surface.tracks.local_motion`, which process one position after the other."""

import math

import numpy as np

from marey.compiled.kernel_order import insert, middle
from marey.compiled.kernels import kernel
from marey.geometry.rotation_fit import fit_rotation


@kernel
def move_rigidly(places, start, end, used, neighbours, moved, spread):
    """Move positions by the best-fitting rigid motion of their neighbours, see `local_motion.moved_rigidly`.

    Args:
        places: (n, 3) positions before.
        start: (n, k, 3) neighbours before.
        end: (n, k, 3) neighbours afterwards.
        used: (n, k) which of the neighbours are used.
        neighbours: number of neighbours of which half are required.
        moved: (n, 3) for the positions afterwards; NaN without the required neighbours.
        spread: (n,) for the standard deviation of the neighbours from the motion; NaN likewise.
    """
    most = start.shape[1]
    kept, ordered, typical = np.empty(most, np.int64), np.empty(most), np.empty(3)
    work, cross, turn = np.empty((2, 4, 4)), np.empty((3, 3)), np.empty((3, 3))
    before, after = np.empty(3), np.empty(3)
    for n in range(len(places)):
        moved[n], spread[n] = np.nan, np.nan
        count = 0
        for k in range(most):
            if used[n, k]:
                kept[count] = k
                count += 1
        if count == 0 or 2 * count < neighbours:
            continue
        for i in range(3):
            for k in range(count):
                insert(ordered, k, end[n, kept[k], i] - start[n, kept[k], i])
            typical[i] = middle(ordered, count)
        count = _without_farthest(start[n], end[n], kept, count, typical)
        if count == 0:
            continue
        _average(start[n], kept, count, before)
        _average(end[n], kept, count, after)
        for i in range(3):
            for j in range(3):
                total = 0.0
                for k in range(count):
                    total += (end[n, kept[k], i] - after[i]) * (start[n, kept[k], j] - before[j])
                cross[i, j] = total
        fit_rotation(cross, work, turn)
        squares = 0.0
        for i in range(3):
            moved[n, i] = after[i]
            for j in range(3):
                moved[n, i] += turn[i, j] * (places[n, j] - before[j])
            for k in range(count):
                rest = end[n, kept[k], i] - after[i]
                for j in range(3):
                    rest -= turn[i, j] * (start[n, kept[k], j] - before[j])
                squares += rest * rest
        spread[n] = math.sqrt(squares / max(3 * count - 6, 1))


@kernel
def _without_farthest(start, end, kept, count, typical):
    """Remove the neighbour whose step differs most from the median; return how many are left."""
    worst, largest = 0, -1.0
    for k in range(count):
        apart = 0.0
        for i in range(3):
            apart += (end[kept[k], i] - start[kept[k], i] - typical[i]) ** 2
        if apart > largest:
            worst, largest = k, apart
    for k in range(worst + 1, count):
        kept[k - 1] = kept[k]
    return count - 1


@kernel
def _average(places, kept, count, out):
    """Write the mean of some places."""
    for i in range(3):
        total = 0.0
        for k in range(count):
            total += places[kept[k], i]
        out[i] = total / count
