"""Cameras that were exchanged, or whose images are upside down, from some picture on: from each view alone.

The pictures of two cameras agree on their relative pose on one side of the change only. On the other side they agree
with the same pose once the pictures of the two cameras are exchanged, or those of one are turned by 180 degrees.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.calibration.sights.board_sights import BoardSights, PoseReadings, board_sights
from marey.calibration.sights.clock_faults import PairedSights

_LEAST_SIDE = 3
"""Least number of common pictures that agree as they are, and of those that agree after the change; by hand."""
_LEAST_GAIN = 6
"""Least number of common pictures that agree in addition; chosen by hand."""
_LEAST_EXPLAINED = 0.6
"""Least share of the common pictures without agreement that agree in addition; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Switch:
    """A change from some picture on after which pictures must be read in another way."""

    kind: str
    """exchanged or turned."""
    cameras: tuple[int, ...]
    """The two cameras that were exchanged, or the one whose images are upside down."""
    picture: int
    """The first common picture after the change."""
    before: int
    """Number of common pictures of two cameras that agree on their relative poses as they are."""
    after: int
    """The same with the change."""
    common: int
    """Number of common pictures of two cameras with the change."""


def find_switch(corners: CornerSet, board: CalibrationBoard, lenses: Floats, paired: PairedSights) -> Switch | None:
    """Find cameras that were exchanged or turned from some picture on.

    Args:
        corners: The corners of all pictures.
        board: The board.
        lenses: (C, 9) approximate lenses.
        paired: The poses of the board in these corners.

    Returns:
        The change after which most pictures agree; None if no change lets enough more pictures agree.
    """
    found = []
    for kind, cameras, read in _readings(corners):
        own = board_sights(read.subset(np.isin(read.camera, cameras)), board, lenses)
        unchanged = ~np.isin(np.arange(len(lenses)), cameras)
        other = BoardSights(
            rotation=np.where(unchanged[:, None, None, None], paired.sights.rotation, own.rotation),
            centre=np.where(unchanged[:, None, None], paired.sights.centre, own.centre),
        )
        found += [each for each in _best(paired, other, kind, cameras) if _counts(each)]
    return max(found, key=lambda each: each.after, default=None)


def _counts(switch: Switch) -> bool:
    gain = switch.after - switch.before
    return gain >= max(_LEAST_GAIN, _LEAST_EXPLAINED * (switch.common - switch.before))


def _readings(corners: CornerSet) -> Iterator[tuple[str, tuple[int, ...], CornerSet]]:
    """Iterate over other readings of the corners: kind, cameras, and the corners with all their pictures changed."""
    cameras = range(len(corners.cameras))
    upside_down = replace(corners, pixels=np.array(corners.sizes)[corners.camera] - 1 - corners.pixels)
    for camera in cameras:
        yield "turned", (camera,), upside_down
    for pair in combinations(cameras, 2):
        yield "exchanged", pair, exchanged_corners(corners, *pair)


def exchanged_corners(corners: CornerSet, first: int, second: int) -> CornerSet:
    """Return the corners if the pictures of two cameras are exchanged.

    Args:
        corners: The corners.
        first: A camera.
        second: Another one, whose images have the same size.
    """
    order = np.arange(len(corners.cameras))
    order[[first, second]] = second, first
    other = replace(corners, camera=order[corners.camera])
    return other.ordered(np.lexsort((other.corner, other.camera, other.picture)))


def _best(paired: PairedSights, other: BoardSights, kind: str, cameras: tuple[int, ...]) -> Iterator[Switch]:
    """Return the instant from which another reading lets most pictures agree, if there is one."""
    count = paired.pictures
    before, total, known = 0, np.zeros(count + 1, int), np.zeros(count + 1, int)
    as_they_are, changed = np.zeros(count + 1, int), np.zeros(count + 1, int)
    for pair in paired.poses:
        plain, plain_known = _agreeing(paired, paired.sights, pair)
        before += int(plain.sum())
        if not set(pair) & set(cameras):
            total += int(plain.sum())
            known += int(plain_known.sum())
            continue
        read, read_known = _agreeing(paired, other, pair)
        # The relative pose may be that before or that after the change.
        late, early = _split(plain, read), _split(read, plain)
        forward = late.sum(axis=0) >= early.sum(axis=0)
        total += np.where(forward, late.sum(axis=0), early.sum(axis=0))
        as_they_are += np.where(forward, late[0], early[1])
        changed += np.where(forward, late[1], early[0])
        sides = _split(plain_known, read_known).sum(axis=0), _split(read_known, plain_known).sum(axis=0)
        known += np.where(forward, *sides)
    good = (as_they_are >= _LEAST_SIDE) & (changed >= _LEAST_SIDE)
    if good.any():
        best = int(count - np.argmax(np.where(good, total, -1)[::-1]))
        yield Switch(
            kind=kind, cameras=cameras, picture=best, before=before, after=int(total[best]), common=int(known[best])
        )  # fmt: skip


def _agreeing(paired: PairedSights, sights: BoardSights, pair: tuple[int, int]) -> tuple[Mask, Mask]:
    """Return which pictures (F,) of a pair agree with its relative pose, and which have one."""
    (a, b), (turn, shift) = pair, paired.poses[pair]
    readings = PoseReadings.between((sights.rotation[a], sights.centre[a]), (sights.rotation[b], sights.centre[b]))
    return np.asarray(readings.deviations(turn[None], shift[None])[0] < 1.0), readings.exists


def _split(before: Mask, after: Mask) -> Integers:
    """Return the sums (2, F + 1) of one array before each instant and of another from there on."""
    sums = np.concatenate([[0], np.cumsum(before)]), np.concatenate([np.cumsum(after[::-1])[::-1], [0]])
    return np.stack(sums).astype(np.int64)
