"""Detection of gross errors: matches that contradict neighbouring patches or the reverse match."""

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.images.matching.matching import MatchSettings, match
from marey.surface.points.field import Field, Grid
from marey.surface.points.settings import MATCH_CHECK_DEFAULTS, MatchCheckSettings
from marey.surface.points.views import SurfaceView


def agreeing(
    field: Field, grid: Grid, spread: Floats, settings: MatchCheckSettings = MATCH_CHECK_DEFAULTS
) -> tuple[Integers, Integers]:
    """Count the neighbours of each node, and those that agree with it.

    Two neighbours agree if each one's affine map predicts the other one's position.

    Args:
        field: The matches.
        grid: The nodes of the field.
        spread: (n,) standard deviation of each match [px].
        settings: Largest distance of neighbours that agree.

    Returns:
        Number of the eight neighbours with a match, and number of these that agree (n,).
    """
    found = np.flatnonzero(field.found)
    beside = grid.neighbours(found)
    there = (beside >= 0) & field.found[beside]
    step = grid.pixels[beside] - grid.pixels[found][:, None]
    apart = field.there[beside] - field.there[found][:, None]
    noise = np.hypot(spread[beside], spread[found][:, None])
    allowed = settings.tolerance_px + settings.spacing_ratio * grid.spacing + settings.deviations * noise
    fits = np.ones(there.shape, bool)
    for maps in (field.maps[found][:, None], field.maps[beside]):
        beyond = apart - np.einsum("...ij,...j->...i", maps, step)
        fits &= np.linalg.norm(beyond, axis=-1) <= allowed
    counts = np.zeros((2, len(grid)), np.int64)
    counts[0, found], counts[1, found] = there.sum(axis=1), (there & fits).sum(axis=1)
    return counts[0], counts[1]


def continuous(field: Field, grid: Grid, spread: Floats, settings: MatchCheckSettings = MATCH_CHECK_DEFAULTS) -> Field:
    """Keep the continuous part of a field: nodes with which most neighbours agree, in pieces of sufficient size.

    Args:
        field: The matches.
        grid: The nodes of the field.
        spread: (n,) standard deviation of each match [px].
        settings: Which neighbours agree, how many of them are needed, and the least size of a piece.

    Returns:
        The remaining matches.
    """
    neighbours, same = agreeing(field, grid, spread, settings)
    field = field.only((same >= settings.agreeing_neighbours) & (same >= settings.agreeing_share * neighbours))
    return field.only(in_large_pieces(field.found, grid, settings))


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
