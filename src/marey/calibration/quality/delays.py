"""Cameras that recorded every picture a constant number of pictures too late, from the motion of the board alone.

Before any relative pose is known, each camera sees the board turn. Between the same two instants the rotation of the
board in the axes of two cameras is the same up to one constant rotation, wherever the cameras are. The lag at which
one rotation explains the turns of most pictures is the delay between the two.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.solve import agreeing_pictures
from marey.calibration.adjustment.start import plane_poses
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.geometry import rotations

_GAPS = (1, 2, 4)
"""Distances between the two pictures of a turn [pictures]; chosen by hand: a board is seldom seen for long."""
_MOST_LAG = 60
"""Largest delay that is searched [pictures]: six seconds at the usual ten pictures per second. Chosen by hand."""
_LEAST_TURNS = 20
"""Least number of common turns at which a lag is tried; chosen by hand."""
_LEAST_MOTION = np.radians(4.0)
"""Root mean square of the turns with which a lag can be recognised [rad]: those of views from afar are known to 1 or 2
degrees. Chosen by hand."""
_GREATEST_TURN = np.radians(150.0)
"""Largest turn that is used [rad]: the vector of a half turn has two signs."""
_TURN_SD = np.radians(2.0)
"""Deviation beyond which a turn does not count against a lag any more [rad]; chosen by hand."""
_GREATEST_DEVIATION = 0.1
"""Largest mean deviation of the turns at which a lag counts.

In made sessions of 4 and 8 cameras with 110 to 600 pictures and delays of 0 to 25 pictures, it was 0.008 to 0.05 at the
true lag of two cameras, and 0.11 or more at wrong lags."""
_SMALLER = 0.5
"""Factor to which a lag must reduce the mean deviation from that at all lags that are not its neighbours; by hand."""
_NEIGHBOURS = 2
"""Distance up to which lags are neighbours [pictures]: a board turns evenly for a moment. Chosen by hand."""
_ROUNDS = 4
"""Number of times that the constant rotation and the weights of the turns are estimated in turn."""


@dataclass(frozen=True, kw_only=True)
class CameraDelay:
    """A camera whose pictures are all late or early."""

    camera: int
    pictures: int
    """Number of pictures by which it is late; negative where it is early."""
    turns: int
    """Number of turns of the board from which it was found."""


@dataclass(frozen=True, eq=False)
class _Turns:
    """The turns of the board in the axes of one camera, by gap."""

    vector: Floats
    """(G, F, 3) rotation vectors from one picture to the later one [rad]; NaN where unknown."""


@dataclass(frozen=True, kw_only=True)
class PairLag:
    """The lag at which two cameras see the same turns."""

    first: int
    second: int
    lag: int
    """Number of pictures by which the second is later than the first."""
    deviation: float
    """Mean deviation of the turns at this lag, from 0 for equal turns to 1 [-]."""
    elsewhere: float
    """The smallest at any lag that is no neighbour of this one; 1 where none was tried."""
    turns: int


def find_delays(corners: CornerSet, board: CalibrationBoard, lenses: Floats) -> tuple[CameraDelay, ...]:
    """Find cameras whose pictures are late by a constant number of pictures.

    Args:
        corners: The corners of all pictures, which follow each other at a constant rate.
        board: The board.
        lenses: (C, 9) approximate lenses.

    Returns:
        The cameras that are late or early relative to most others; of two that differ, the second. Empty unless more
        pictures agree on the relative poses of the cameras without the delays.
    """
    delays = _delays_of_turns(corners, board, lenses)
    if not delays:
        return ()
    before = agreeing_pictures(corners, board, lenses)
    return delays if agreeing_pictures(without_delays(corners, delays), board, lenses) > before else ()


def _delays_of_turns(corners: CornerSet, board: CalibrationBoard, lenses: Floats) -> tuple[CameraDelay, ...]:
    turns = [_turns_of(corners, board, lenses, camera) for camera in range(len(corners.cameras))]
    pairs = [found for a, b in combinations(range(len(turns)), 2) if (found := _pair_lag(turns, a, b)) is not None]
    late = _common_delays(len(turns), pairs)
    return tuple(
        CameraDelay(
            camera=int(camera), pictures=int(late[camera]),
            turns=sum(each.turns for each in pairs if camera in (each.first, each.second)),
        )
        for camera in np.flatnonzero(late)
    )  # fmt: skip


def without_delays(corners: CornerSet, delays: Sequence[CameraDelay]) -> CornerSet:
    """Assign the pictures of late cameras to the instants that they show.

    Args:
        corners: The corners of all pictures.
        delays: The cameras that are late.

    Returns:
        The corners; pictures of instants before the first or after the last are left out.
    """
    late = late_pictures(len(corners.cameras), delays)
    picture = corners.picture - late[corners.camera]
    moved = replace(corners, picture=picture).subset((picture >= 0) & (picture < len(corners.pictures)))
    return moved.ordered(np.lexsort((moved.corner, moved.camera, moved.picture)))


def late_pictures(cameras: int, delays: Sequence[CameraDelay]) -> Integers:
    """Return by how many pictures (C,) each camera is late."""
    late = np.zeros(cameras, np.int64)
    for each in delays:
        late[each.camera] = each.pictures
    return late


def _turns_of(corners: CornerSet, board: CalibrationBoard, lenses: Floats, camera: int) -> _Turns:
    """Return the turns of the board that one camera sees, from the pose of the board in each picture alone."""
    pose = np.full((len(corners.pictures), 3, 3), np.nan)
    for view in np.flatnonzero(corners.view_camera == camera):
        found = plane_poses(corners, board, lenses, int(view))
        # Of a plane that is seen from afar both poses fit; such pictures say nothing certain.
        if len(found) == 1:
            pose[corners.view_picture[view]] = found[0].rotation
    vector = np.full((len(_GAPS), len(pose), 3), np.nan)
    for row, gap in enumerate(_GAPS):
        both = np.flatnonzero(np.isfinite(pose[gap:, 0, 0]) & np.isfinite(pose[: len(pose) - gap, 0, 0]))
        if len(both):
            turn = rotations.log(pose[both + gap] @ pose[both].transpose(0, 2, 1))
            small = np.linalg.norm(turn, axis=1) < _GREATEST_TURN
            vector[row, both[small]] = turn[small]
    return _Turns(vector)


def _pair_lag(turns: Sequence[_Turns], first: int, second: int) -> PairLag | None:
    """Return the lag that explains the turns of two cameras best; None if none can be recognised."""
    most = min(_MOST_LAG, turns[first].vector.shape[1] // 4)
    found: dict[int, tuple[float, int]] = {}
    near = range(-_NEIGHBOURS, _NEIGHBOURS + 1)
    for lag in (*near, *(k for k in range(-most, most + 1) if k not in near)):
        if abs(lag) > _NEIGHBOURS and found.get(0, (1.0, 0))[0] < _GREATEST_DEVIATION:
            # Cameras that agree without a lag have none, or only a small one.
            break
        a, b = _common_turns(turns[first].vector, turns[second].vector, lag)
        if len(a) >= _LEAST_TURNS and np.sqrt(np.mean(np.sum(a**2, axis=1))) > _LEAST_MOTION:
            found[lag] = _deviation(a, b), len(a)
    if not found:
        return None
    lag = min(found, key=lambda each: found[each][0])
    others = [each for k, (each, _) in found.items() if abs(k - lag) > _NEIGHBOURS]
    return PairLag(
        first=first, second=second, lag=lag, deviation=found[lag][0], turns=found[lag][1],
        elsewhere=min(others, default=1.0),
    )  # fmt: skip


def _common_turns(first: Floats, second: Floats, lag: int) -> tuple[Floats, Floats]:
    """Return the turns (n, 3) of two cameras between the same instants if the second is late by a lag."""
    count = first.shape[1]
    a = first[:, max(0, -lag) : count - max(0, lag)].reshape(-1, 3)
    b = second[:, max(0, lag) : count - max(0, -lag)].reshape(-1, 3)
    known = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    return a[known], b[known]


def _deviation(first: Floats, second: Floats) -> float:
    """Return how much the turns (n, 3) of two cameras differ after the one rotation that explains most of them.

    Each deviation counts relative to the turn, or to the error of a turn where that is larger, and up to one.
    """
    size = np.maximum(np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1))
    limit = np.maximum(0.5 * size, _TURN_SD)
    # Equal lengths do not depend on the rotation, so the first weights come from them.
    apart = np.abs(np.linalg.norm(first, axis=1) - np.linalg.norm(second, axis=1))
    share = np.ones(len(first))
    for _ in range(_ROUNDS):
        weight = 1.0 / (1.0 + np.square(apart / (0.3 * limit)))
        turn = rotations.nearest(np.einsum("n,ni,nj->ij", weight, second, first))
        apart = np.linalg.norm(second - first @ turn.T, axis=1)
        share = np.minimum(apart / limit, 1.0)
    counted = size > 0.5 * np.median(size)
    return float(np.mean(share[counted]))


def _common_delays(cameras: int, pairs: Sequence[PairLag]) -> Integers:
    """Return by how many pictures (C,) each camera is late: zero for the largest group of cameras that agree."""
    clear = [
        each for each in pairs
        if each.deviation < _GREATEST_DEVIATION and each.deviation < _SMALLER * each.elsewhere
    ]  # fmt: skip
    late, joined = np.zeros(cameras, np.int64), np.arange(cameras)
    for each in sorted(clear, key=lambda each: each.deviation / np.sqrt(each.turns)):
        a, b = joined[each.first], joined[each.second]
        if a != b:
            moved = joined == b
            late[moved] += late[each.first] + each.lag - late[each.second]
            joined[moved] = a
    for group in np.unique(joined):
        own = np.flatnonzero(joined == group)
        values, counts = np.unique(late[own], return_counts=True)
        # Of equally large groups the clock of the first camera counts.
        most = values[counts == counts.max()]
        base = next(late[camera] for camera in own if late[camera] in most)
        late[own] -= base
    return late


def named_delays(corners: CornerSet, delays: Sequence[CameraDelay]) -> Mapping[str, int]:
    """Return by how many pictures cameras are late, by name."""
    return {corners.cameras[each.camera]: each.pictures for each in delays}
