"""Detection of gross errors: matches that contradict neighbouring patches or the reverse match."""

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.images.matching.matching import MatchSettings, match
from marey.surface.points.field import Field, Grid
from marey.surface.points.views import SurfaceView

_TOLERANCE = 0.3
"""Largest distance of a match from the prediction by its neighbour's affine map, without spacing and noise [px]. Chosen
by hand."""
_BENT = 0.05
"""Increase of this distance per pixel of the spacing, because the maps vary between patches. Chosen by hand."""
_SDS = 3.0
"""Increase of this distance per standard deviation of the two matches. Chosen by hand."""
_AGREEING = 3
"""Least number of neighbours that agree. Chosen by hand."""
_MAJORITY = 0.5
"""Least share of the neighbours that agree. Chosen by hand."""
_ISLAND = 16
"""Least width and height of a piece of surface, in pixels of the template: about one patch. Chosen by hand."""
_BACK = 1.0
"""Largest distance between the start and the end of a match forward and backward [px]. Chosen by hand."""


def agreeing(field: Field, grid: Grid, spread: Floats) -> tuple[Integers, Integers]:
    """Count the neighbours of each node, and those that agree with it.

    Two neighbours agree if each one's affine map predicts the other one's position.

    Args:
        field: The matches.
        grid: The nodes of the field.
        spread: (n,) standard deviation of each match [px].

    Returns:
        Number of the eight neighbours with a match, and number of these that agree (n,).
    """
    found = np.flatnonzero(field.found)
    beside = grid.neighbours(found)
    there = (beside >= 0) & field.found[beside]
    step = grid.pixels[beside] - grid.pixels[found][:, None]
    apart = field.there[beside] - field.there[found][:, None]
    allowed = _TOLERANCE + _BENT * grid.spacing + _SDS * np.hypot(spread[beside], spread[found][:, None])
    fits = np.ones(there.shape, bool)
    for maps in (field.maps[found][:, None], field.maps[beside]):
        beyond = apart - np.einsum("...ij,...j->...i", maps, step)
        fits &= np.linalg.norm(beyond, axis=-1) <= allowed
    counts = np.zeros((2, len(grid)), np.int64)
    counts[0, found], counts[1, found] = there.sum(axis=1), (there & fits).sum(axis=1)
    return counts[0], counts[1]


def continuous(field: Field, grid: Grid, spread: Floats) -> Field:
    """Keep the continuous part of a field: nodes with which most neighbours agree, in pieces of sufficient size.

    Args:
        field: The matches.
        grid: The nodes of the field.
        spread: (n,) standard deviation of each match [px].

    Returns:
        The remaining matches.
    """
    neighbours, same = agreeing(field, grid, spread)
    field = field.only((same >= _AGREEING) & (same >= _MAJORITY * neighbours))
    return field.only(in_large_pieces(field.found, grid))


def in_large_pieces(found: Mask, grid: Grid) -> Mask:
    """Return which nodes (n,) belong to sufficiently large connected pieces of surface."""
    if not len(grid):
        return found
    picture = found.reshape(grid.rows, grid.columns).astype(np.uint8)
    _, label, sizes, _ = cv2.connectedComponentsWithStats(picture, connectivity=4)
    least = max(4.0, (_ISLAND / grid.spacing) ** 2)
    large = sizes[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return np.asarray(large[label].ravel())


def confirmed_backward(
    template: SurfaceView, search: SurfaceView, pixels: Floats, there: Floats, maps: Floats, sizes: Integers
) -> Mask:
    """Return which matches (n,) are confirmed by matching backward from the search image to the template.

    Args:
        template: The view from which the patches were taken.
        search: The view in which they were found.
        pixels: (n, 2) centres of the patches in the template [px].
        there: (n, 2) matched positions in the search image [px].
        maps: (n, 2, 2) affine maps of the patches.
        sizes: (n,) sizes of the patches [px].

    Returns:
        (n,) true for confirmed matches.
    """
    back = np.zeros(len(pixels), bool)
    for size in np.unique(sizes):
        some = np.flatnonzero(sizes == size)
        rules = MatchSettings(size=int(size), noise=search.noise, reach=2.0)
        found = match(
            search.spline, template.spline, there[some], pixels[some], maps=np.linalg.inv(maps[some]), settings=rules
        )  # fmt: skip
        away = np.linalg.norm(found.pixels - pixels[some], axis=1)
        back[some] = found.converged & (np.nan_to_num(away, nan=np.inf) <= _BACK)
    return back
