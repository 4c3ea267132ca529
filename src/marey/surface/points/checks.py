"""Detection of gross errors: matches that contradict neighbouring patches or the reverse match."""

import math

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.compiled.kernels import kernel
from marey.images.matching.matching import MatchSettings, match
from marey.surface.points.field import Grid
from marey.surface.points.settings import MATCH_CHECK_DEFAULTS, MatchCheckSettings
from marey.surface.points.views import SurfaceView


def agreeing(
    there: Floats, maps: Floats, found: Mask, grid: Grid, spread: Floats,
    settings: MatchCheckSettings = MATCH_CHECK_DEFAULTS,
) -> tuple[Integers, Integers]:  # fmt: skip
    """Count the neighbours of each node, and those that agree with it.

    Two neighbours agree if each one's affine map predicts the other one's position.

    Args:
        there: (n, 2) matched positions in the search image [px].
        maps: (n, 2, 2) linear parts of the affine maps.
        found: (n,) true for nodes with a match.
        grid: The n nodes.
        spread: (n,) standard deviation of each match [px].
        settings: Largest distance of neighbours that agree.

    Returns:
        Number of the eight neighbours with a match, and number of these that agree (n,).
    """
    counts = np.zeros((2, len(grid)), np.int64)
    allowed = settings.tolerance_px + settings.spacing_ratio * grid.spacing
    _count_agreeing(
        np.ascontiguousarray(there), np.ascontiguousarray(maps).reshape(len(grid), 4), found,
        np.ascontiguousarray(spread, float), grid.rows, grid.columns, float(grid.spacing), allowed,
        settings.deviations, counts,
    )  # fmt: skip
    return counts[0], counts[1]


@kernel
def _count_agreeing(there, maps, found, spread, rows, columns, spacing, allowed, deviations, counts):
    """Count matched neighbours, and those that agree; the tests compare it with a plain formula.

    Each pair of neighbours is compared once: a node with the next one in its row and three of the next row.
    """
    for node in range(rows * columns):
        if not found[node]:
            continue
        row, column = node // columns, node % columns
        for k in range(4):
            i, j = (0, 1) if k == 0 else (1, k - 2)
            if row + i >= rows or column + j < 0 or column + j >= columns:
                continue
            other = node + i * columns + j
            if not found[other]:
                continue
            x, y = j * spacing, i * spacing
            apart_x, apart_y = there[other, 0] - there[node, 0], there[other, 1] - there[node, 1]
            limit = allowed + deviations * math.sqrt(spread[other] ** 2 + spread[node] ** 2)
            own = _beyond(maps[node], x, y, apart_x, apart_y)
            same = own <= limit and _beyond(maps[other], x, y, apart_x, apart_y) <= limit
            for each in (node, other):
                counts[0, each] += 1
                counts[1, each] += same


@kernel
def _beyond(linear, x, y, apart_x, apart_y):
    """Return the distance of a step between two matches from that which a map predicts [px]."""
    u, v = apart_x - linear[0] * x - linear[1] * y, apart_y - linear[2] * x - linear[3] * y
    return math.sqrt(u * u + v * v)


def continuous(
    there: Floats, maps: Floats, found: Mask, grid: Grid, spread: Floats,
    settings: MatchCheckSettings = MATCH_CHECK_DEFAULTS,
) -> Mask:  # fmt: skip
    """Return the continuous part of a field: nodes with which most neighbours agree, in pieces of sufficient size.

    Args:
        there: (n, 2) matched positions in the search image [px].
        maps: (n, 2, 2) linear parts of the affine maps.
        found: (n,) true for nodes with a match.
        grid: The n nodes.
        spread: (n,) standard deviation of each match [px].
        settings: Which neighbours agree, how many of them are needed, and the least size of a piece.

    Returns:
        (n,) true for the matches that remain.
    """
    neighbours, same = agreeing(there, maps, found, grid, spread, settings)
    enough = (same >= settings.agreeing_neighbours) & (same >= settings.agreeing_share * neighbours)
    return in_large_pieces(found & enough, grid, settings)


def in_large_pieces(found: Mask, grid: Grid, settings: MatchCheckSettings = MATCH_CHECK_DEFAULTS) -> Mask:
    """Return which nodes (n,) belong to sufficiently large connected pieces of surface."""
    if not len(grid):
        return found
    picture = found.reshape(grid.rows, grid.columns).astype(np.uint8)
    _, label, sizes, _ = cv2.connectedComponentsWithStats(picture, connectivity=4)
    least = max(4.0, (settings.piece_px / grid.spacing) ** 2)
    large = sizes[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return np.asarray(large[label].ravel())


def confirmed_backward(
    template: SurfaceView, search: SurfaceView, pixels: Floats, there: Floats, maps: Floats, sizes: Integers,
    settings: MatchCheckSettings = MATCH_CHECK_DEFAULTS,
) -> Mask:  # fmt: skip
    """Return which matches (n,) are confirmed by matching backward from the search image to the template.

    Args:
        template: The view from which the patches were taken.
        search: The view in which they were found.
        pixels: (n, 2) centres of the patches in the template [px].
        there: (n, 2) matched positions in the search image [px].
        maps: (n, 2, 2) affine maps of the patches.
        sizes: (n,) sizes of the patches [px].
        settings: Largest distance of a confirmed match from its start.

    Returns:
        (n,) true for confirmed matches.
    """
    back = np.zeros(len(pixels), bool)
    for size in np.unique(sizes):
        some = np.flatnonzero(sizes == size)
        rules = MatchSettings(size=int(size), noise=search.noise, reach=settings.backward_reach_px)
        found = match(
            search.spline, template.spline, there[some], pixels[some], maps=np.linalg.inv(maps[some]), settings=rules
        )  # fmt: skip
        away = np.linalg.norm(found.pixels - pixels[some], axis=1)
        back[some] = found.converged & (np.nan_to_num(away, nan=np.inf) <= settings.backward_px)
    return back
