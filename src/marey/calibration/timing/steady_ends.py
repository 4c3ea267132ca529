"""Ends of a wand that look alike, followed from picture to picture of each camera.

A solution has the same end first in all cameras of a picture, but it may be another end in the next one. Paths in time
need the same end in all pictures of a camera; which end that is in one camera and in another follows from a solution.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.wand_session import with_upper_end_first
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationWand

_UNCLEAR = 0.5
"""Ratio of the distances from the prediction in both orders of the ends from which it is not clear which end is which:
there a path is not followed any further. Chosen by hand."""


def with_steady_ends(corners: CornerSet, wand: CalibrationWand) -> CornerSet:
    """Order the ends of a wand that look alike so that each moves on evenly in the image.

    The first picture of a run begins with the upper end.

    Args:
        corners: Points of the wand in consecutive pictures.
        wand: The wand.

    Returns:
        The points; those of a wand whose ends differ as they are.
    """
    if not wand.alike:
        return corners
    corners = with_upper_end_first(corners, wand)
    followed = [_followed(own) for own in _points(corners, len(wand.points))]
    return exchanged_ends(corners, wand, np.stack([exchanged for exchanged, _ in followed]))


def with_agreeing_ends(
    corners: CornerSet, solved: CornerSet, late: Floats, wand: CalibrationWand
) -> CornerSet:  # fmt: skip
    """Order the steady ends of a wand that look alike so that all cameras have the same end first.

    Args:
        corners: Points of the wand with steady ends.
        solved: Points at the instants of the others, in each picture with the same end first in all cameras.
        late: (C,) by how much each camera is late [pictures].
        wand: The wand.

    Returns:
        The points with steady ends, of which the same is first in all cameras that share pictures.
    """
    if not wand.alike:
        return corners
    table, right = _points(corners, len(wand.points)), _points(solved, len(wand.points))
    runs: list[_EndRun] = []
    for camera, lag in enumerate(np.round(late).astype(int)):
        instant = np.arange(table.shape[1]) - lag
        near = right[camera, np.clip(instant, 0, right.shape[1] - 1)]
        near[(instant < 0) | (instant >= right.shape[1])] = np.nan
        apart, turned = _both_orders(table[camera], near)
        order = np.sign(np.nan_to_num(turned - apart))
        group = np.cumsum(_followed(table[camera])[1])
        for each in np.unique(group):
            own = np.flatnonzero((group == each) & np.isfinite(table[camera, :, 0, 0]))
            if len(own):
                runs.append(_EndRun(camera=camera, pictures=own, instants=instant[own], order=order[own]))
    exchanged = np.zeros(table.shape[:2], bool)
    for run, turn in zip(runs, _agreeing_turns(runs, right.shape[1]), strict=True):
        exchanged[run.camera, run.pictures] = turn
    return exchanged_ends(corners, wand, exchanged)


@dataclass(frozen=True, eq=False, kw_only=True)
class _EndRun:
    """Pictures of a camera in which the ends are followed."""

    camera: int
    pictures: Integers
    """(n,)."""
    instants: Integers
    """(n,) the instants that they show, on the clock of the others."""
    order: Floats
    """(n,) 1 where the ends have the order of the solution, -1 where the other, 0 where that is not known."""


def _agreeing_turns(runs: list[_EndRun], count: int) -> Mask:
    """Return which runs have to be exchanged so that those that share instants have the same end first.

    The pairs of runs with the clearest majority of common instants are joined first.
    """
    table = np.zeros((len(runs), count))
    for row, run in zip(table, runs, strict=True):
        inside = (run.instants >= 0) & (run.instants < count)
        row[run.instants[inside]] = run.order[inside]
    votes = table @ table.T
    turn, joined = np.zeros(len(runs), bool), np.arange(len(runs))
    for a, b in sorted(combinations(range(len(runs)), 2), key=lambda pair: -abs(votes[pair])):
        if votes[a, b] and joined[a] != joined[b]:
            moved = joined == joined[b]
            turn[moved] ^= bool(turn[a] ^ turn[b] ^ (votes[a, b] < 0))
            joined[moved] = joined[a]
    return turn


def _followed(points: Floats) -> tuple[Mask, Mask]:
    """Return which pictures (F,) to exchange so that each end (F, K, 2) moves on evenly, and where that begins anew."""
    exchanged, new = np.zeros(len(points), bool), np.zeros(len(points), bool)
    before = two_before = np.full(points.shape[1:], np.nan)
    for picture, own in enumerate(points):
        # A constant velocity, or the place in the last picture, predicts the next.
        ahead = np.where(np.isfinite(two_before), 2.0 * before - two_before, before)
        apart, turned = (float(each[0]) for each in _both_orders(own[None], ahead[None]))
        exchanged[picture] = turned < apart
        new[picture] = not min(apart, turned) < _UNCLEAR * max(apart, turned)
        two_before, before = before, own[::-1] if exchanged[picture] else own
    return exchanged, new


def _both_orders(points: Floats, near: Floats) -> tuple[Floats, Floats]:
    """Return how far the ends of points (F, K, 2) are from others (F,), as they are and exchanged."""
    ends = [0, points.shape[1] - 1]
    apart = np.linalg.norm((points - near)[:, ends], axis=2).sum(axis=1)
    turned = np.linalg.norm((points[:, ::-1] - near)[:, ends], axis=2).sum(axis=1)
    return apart, turned


def _points(corners: CornerSet, marks: int) -> Floats:
    """Return the points (C, F, K, 2) of a wand [px]; NaN where they were not found."""
    table = np.full((len(corners.cameras), len(corners.pictures), marks, 2), np.nan)
    own = corners.corner < marks
    table[corners.camera[own], corners.picture[own], corners.corner[own]] = corners.pixels[own]
    return table


def exchanged_ends(corners: CornerSet, wand: CalibrationWand, exchanged: Mask) -> CornerSet:
    """Exchange the ends of a wand in some views.

    Args:
        corners: Points of the wand.
        wand: The wand.
        exchanged: (C, F) views whose ends are exchanged.
    """
    last = len(wand.points) - 1
    turned = exchanged[corners.camera, corners.picture]
    corner = np.where(turned, last - corners.corner, corners.corner)
    return replace(corners, corner=corner).ordered(np.lexsort((corner, corners.camera, corners.picture)))
