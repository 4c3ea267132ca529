"""One camera with another clock than the others, from the poses of the board in its views alone.

Synchronous pictures of two cameras have one relative pose. If the clock of one camera is late, drifts, or jumps since
pictures were lost, one relative pose explains the pictures only after each was assigned to the instant that it shows.
The relative poses and the clock are estimated together, before any common solution.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy.optimize

from marey.arrays import Floats, Integers
from marey.calibration.sights.board_sights import BoardSights, PoseReadings, common_pose, refined_pose

_MOST_LAG = 10
"""Largest lag of a single picture that is searched [pictures]: two seconds of a board that is carried. By hand."""
_STEP = 0.5
"""Step of the lags that are searched [pictures]; chosen by hand."""
_LAGS = np.arange(-_MOST_LAG, _MOST_LAG + _STEP / 2, _STEP)
"""The lags that are searched [pictures]."""
_LEAST_PICTURES = 10
"""Least number of common pictures of a camera with the others; chosen by hand."""
_LEAST_COMMON = 0.7
"""Least number of common pictures with another clock, as a share of those with the given one; chosen by hand."""
_LEAST_SIDE = 3
"""Least number of common pictures before and after pictures were lost; chosen by hand."""
_MOST_STEPS = 120
"""Largest number of evaluations of a clock; chosen by hand."""
_NOT_BETTER = 1.25
"""Ratio of the deviations up to which the clock with fewer unknowns is preferred; chosen by hand."""

_LEAST_EXPLAINED = 0.5
"""Least share of the deviations that the clock of one camera must explain.

In the sessions of `bench run capture/planted_faults` with the seeds 0 to 2, wrong clocks explained at most 0.33 and the
planted ones at least 0.69."""
_ROUNDS = 20
"""Number of times that lags are weighted anew for the line through them; chosen by hand."""
_LEAST_APART = 0.1
"""Distance from the line below which the weights of lags do not grow any more [pictures]; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ClockFault:
    """Another clock of one camera, which makes the relative poses of the cameras agree."""

    kind: str
    """late, drift, or lost."""
    camera: int
    begin: float
    """By how many pictures it is late at the first picture that it shares with others."""
    end: float
    """The same at the last one."""
    picture: int | None
    """Its first picture after the loss; None where none were lost."""
    before: float
    """Mean deviation of the pictures from one relative pose without it, in those up to which relative poses agree."""
    after: float
    """The same with it."""


class PairedSights:
    """The poses of the board before each camera, and the relative pose of each pair of cameras.

    Args:
        sights: Poses of the board before each camera.
        lagging: Whether one of the cameras may show each instant in another picture.
    """

    def __init__(self, sights: BoardSights, *, lagging: bool):
        self.sights = sights
        cameras, self.pictures = sights.known.shape
        self.poses: dict[tuple[int, int], tuple[Floats, Floats]] = {}
        lags = np.broadcast_to(_LAGS if lagging else np.zeros(1), (self.pictures, len(_LAGS) if lagging else 1))
        for first, second in combinations(range(cameras), 2):
            found = common_pose(self.readings(first, second, lags, first))
            if found is not None:
                self.poses[first, second] = found

    def readings(self, first: int, second: int, lag: Floats, camera: int) -> PoseReadings:
        """Return the relative poses of two cameras if one is late.

        Args:
            first: A camera.
            second: Another one.
            lag: (F, ...) by how many pictures the camera is late at each instant.
            camera: The first or the second one, which is late.
        """
        instant = np.broadcast_to(np.arange(self.pictures).reshape(-1, *[1] * (lag.ndim - 1)), lag.shape)
        late = self.sights.at(camera, np.where(np.isfinite(lag), instant + np.nan_to_num(lag), -1.0))
        other = self.sights.at(second if camera == first else first, instant.astype(float))
        return PoseReadings.between(*((late, other) if camera == first else (other, late)))

    def deviations(self, first: int, second: int, lag: Floats, *, camera: int) -> Floats:
        """Return the bounded deviations (F,) of the pictures of a pair from their relative pose, NaN where unknown.

        Args:
            first: A camera.
            second: Another one.
            lag: (F,) by how many pictures the camera is late at each instant, NaN where it shows nothing.
            camera: The first or the second one.
        """
        readings = self.readings(first, second, lag[:, None], camera)
        turn, shift = refined_pose(readings, *self.poses[first, second])
        square = readings.deviations(turn[None], shift[None])[0, :, 0]
        return np.where(np.isfinite(square), np.minimum(np.sqrt(square), 1.0), np.nan)

    def lags(self, camera: int) -> tuple[Integers, Floats]:
        """Return instants (n,) and by how many pictures a camera is late there, for pictures that some lag explains."""
        instants, found = [], []
        for pair, (turn, shift) in self.poses.items():
            if camera not in pair:
                continue
            readings = self.readings(*pair, np.broadcast_to(_LAGS, (self.pictures, len(_LAGS))), camera)
            square = readings.deviations(turn[None], shift[None])[0]
            # A board that is at rest fits with many lags.
            clear = (square.min(axis=1) < 1.0) & ((square < 1.0).sum(axis=1) <= 2.0 / _STEP)
            instants.append(np.flatnonzero(clear))
            found.append(_LAGS[np.argmin(square[clear], axis=1)])
        if not instants:
            return np.zeros(0, np.int64), np.zeros(0)
        return np.concatenate(instants), np.concatenate(found)


def find_clock_fault(paired: PairedSights) -> ClockFault | None:
    """Find the camera whose clock differs from that of the others.

    Args:
        paired: The sights of all cameras, whose pictures follow each other at a constant rate.

    Returns:
        The fault; None if no clock of one camera explains the deviations of the pictures from relative poses.
    """
    found: list[ClockFault] = []
    for camera in range(len(paired.sights.known)):
        instants, lags = paired.lags(camera)
        if len(instants) >= _LEAST_PICTURES:
            found += _Clocks(paired, camera).fitted(instants, lags)
    return _preferred([each for each in found if each.after < (1.0 - _LEAST_EXPLAINED) * each.before])


def mean_deviation(deviations: Iterable[Floats]) -> float:
    """Return the mean of deviations without those that are unknown; zero if none is known."""
    every = np.concatenate([np.zeros(0), *deviations])
    known = every[np.isfinite(every)]
    return float(known.mean()) if len(known) else 0.0


class _Clocks:
    """Fits of the clock of one camera, with the relative poses to all others."""

    def __init__(self, paired: PairedSights, camera: int):
        self.paired, self.camera = paired, camera
        still = {pair: paired.deviations(*pair, np.zeros(paired.pictures), camera=pair[0]) for pair in paired.poses}
        self.own = [pair for pair in still if camera in pair]
        self.rest = [still[pair] for pair in still if camera not in pair]
        self.before = mean_deviation(still.values())
        self.common = sum(int(np.isfinite(still[pair]).sum()) for pair in self.own)

    def cost(self, lag: Floats) -> float:
        """Return the mean deviation of the pictures of all pairs if the camera is late by (F,) pictures."""
        each = [self.paired.deviations(*pair, lag, camera=self.camera) for pair in self.own]
        # A clock with which the cameras share far fewer pictures does not explain those that are gone.
        common = sum(int(np.isfinite(one).sum()) for one in each)
        few = common < max(_LEAST_PICTURES, _LEAST_COMMON * self.common)
        return 1.0 if few else mean_deviation([*each, *self.rest])

    def fitted(self, instants: Integers, lags: Floats) -> Iterator[ClockFault]:
        """Fit a constant delay, a drift and a loss of pictures, starting from the lags of single pictures (n,)."""
        every = np.arange(self.paired.pictures, dtype=float)
        late, cost = _least(lambda x: self.cost(np.full_like(every, x[0])), np.array([np.median(lags)]))
        yield self._fault("late", late[0], late[0], None, cost)
        first, last = int(instants.min()), int(max(instants.max(), instants.min() + 1))
        share = (every - first) / (last - first)
        start = _line_through(share[instants], lags)
        drift, cost = _least(lambda x: self.cost(x[0] + (x[1] - x[0]) * share), start)
        yield self._fault("drift", drift[0], drift[1], None, cost)
        for before, after, jump in _jumps(instants, lags):
            # Instants between the last picture before a loss and the first one after it were not recorded.
            early = np.where(every + before < jump + after, float(before), np.nan)
            cost = self.cost(np.where(every >= jump, float(after), early))
            yield self._fault("lost", before, after, jump + after, cost)

    def _fault(self, kind: str, begin: float, end: float, picture: int | None, cost: float) -> ClockFault:
        return ClockFault(
            kind=kind, camera=self.camera, begin=float(begin), end=float(end), picture=picture, before=self.before,
            after=cost,
        )  # fmt: skip


def _least(cost: Callable[[Floats], float], start: Floats) -> tuple[Floats, float]:
    """Minimise a function of one or two lags [pictures]."""
    simplex = np.concatenate([start[None], start + 0.3 * np.eye(len(start))])
    options = {"maxfev": _MOST_STEPS, "xatol": 0.01, "fatol": 1e-4, "initial_simplex": simplex}
    found = scipy.optimize.minimize(cost, start, method="Nelder-Mead", options=options)
    return np.asarray(found.x, float), float(found.fun)


def _line_through(share: Floats, lags: Floats) -> Floats:
    """Return the values (2,) at 0 and 1 of the line with the smallest absolute deviations from lags (n,)."""
    weight = np.ones(len(lags))
    slope, offset = 0.0, 0.0
    for _ in range(_ROUNDS):
        slope, offset = np.polyfit(share, lags, 1, w=np.sqrt(weight))
        weight = 1.0 / np.maximum(np.abs(lags - offset - slope * share), _LEAST_APART)
    return np.array([offset, offset + slope])


def _jumps(instants: Integers, lags: Floats) -> Iterator[tuple[int, int, int]]:
    """Iterate over clocks that jump once: lag before and after, and the first instant after the jump."""
    order = np.argsort(instants, kind="stable")
    instant, lag = instants[order], np.round(lags[order]).astype(int)
    for value in np.unique(lag[lag != 0]).tolist():
        for before, after in ((0, value), (value, 0)):
            # The number of pictures that agree, for each place of the jump.
            agreeing = np.cumsum(lag == before)[:-1] + np.cumsum((lag == after)[::-1])[::-1][1:]
            place = int(np.argmax(agreeing))
            sides = np.count_nonzero(lag[: place + 1] == before), np.count_nonzero(lag[place + 1 :] == after)
            if min(sides) >= _LEAST_SIDE:
                yield before, after, int(instant[place + 1])


def _preferred(found: list[ClockFault]) -> ClockFault | None:
    """Return the simplest of the explanations that are about as good as the best."""
    if not found:
        return None
    least = min(each.after for each in found)
    good = [each for each in found if each.after <= _NOT_BETTER * least]
    order = ("late", "lost", "drift")
    # Pictures are skipped more often than inserted: of two cameras, the one that skipped is named.
    return min(good, key=lambda each: (order.index(each.kind), each.end > each.begin, each.after))
