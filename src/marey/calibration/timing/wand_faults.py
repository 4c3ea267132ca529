"""Cameras whose clocks drift, or that lost pictures, from the points of a wand alone.

As for constant delays (`wand_lags`), points that two cameras see at the same instant satisfy one epipolar constraint,
whatever their lenses and poses are. If the pairs of one camera satisfy it badly at every constant lag, clocks that
drift and clocks that jump are tried for this camera, for all its pairs together. The clock that improves all pairs most
is allowed for, and the search is repeated with the points at the instants that they show, until no further clock
explains what is left. If there are several, those before the last are then estimated again beside the others, and
dropped if they no longer improve their pairs.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from marey.arrays import Floats, freeze_fields
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationWand
from marey.calibration.timing.epipolar_fit import epipolar_fit, point_distances
from marey.calibration.timing.wand_lags import (
    GREATEST_DISTANCE,
    LEAST_COMMON_POINTS,
    WandLag,
    WandTracks,
    joined_lags,
    pair_lags,
)

_LEAST_DISTANCE = 1e-5
"""Distances below this one count as this, in longer sides of the image: 0.01 px. Chosen by hand."""
_SUSPECT = 1.6
"""Ratio of the distances of a camera's pairs to those of all others from which its clock is examined. In six made
sessions in step it was 1.5 at most for four cameras; for three, with one other pair, up to 4. Chosen by hand."""
_SUSPECT_ALONE = 0.0006
"""The distance itself, in longer sides of the image, from which the clock of a camera is examined if all its pairs have
it; chosen by hand."""
_NEAR = 0.15
"""Distance from the lags of pairs, which are known to an eighth of a picture, within which a constant delay is fitted
[pictures]."""
_MOST_DRIFT = 6.0
"""Largest change of the delay over the session that is searched [pictures]; chosen by hand."""
_MOST_JUMP = 10
"""Largest number of lost or inserted pictures that is searched; chosen by hand."""
_INSTANTS = 8
"""Number of instants at which a jump is tried first; chosen by hand."""
_LEAST_SIDE = 0.05
"""Least share of the session before and after a jump; chosen by hand."""
_EXPLAINED = 0.75
"""Ratio to which a clock must reduce the distance from that with the best constant delay. In five made sessions in
step, it was 0.92 at least for all cameras. Chosen by hand."""
_MOST_STEPS = 80
"""Largest number of evaluations of a clock; chosen by hand."""
_DECISIVE = 0.8
"""Ratio of the distances from which a jump is preferred to a drift, or another camera to the first; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WandFault:
    """The clock of one camera that differs from those of the others by more than a delay."""

    camera: int
    partner: int
    """Another camera, whose clock is even."""
    late: Floats
    """(F,) by how much the camera is later than the partner at each instant [pictures]; NaN where it recorded none."""
    picture: int | None
    """Its first picture after a loss; None for a drift."""
    before: float
    """Mean distance of the points of its pairs at the best constant delay, in longer sides of the image."""
    after: float
    """The same with this clock."""

    def __post_init__(self) -> None:
        freeze_fields(self, "late")

    @property
    def jump(self) -> int:
        """Change of the delay after the loss [pictures]: negative if pictures were lost; zero for a drift."""
        known = self.late[np.isfinite(self.late)]
        return 0 if self.picture is None else round(float(known[-1] - known[0]))

    @property
    def drift(self) -> float:
        """Change of the delay per picture; zero for a loss."""
        return 0.0 if self.picture is not None else float(np.mean(np.diff(self.late)))

    def retimed(self, corners: CornerSet) -> CornerSet:
        """Return the corners with the pictures of the camera after a loss at the instants that they show."""
        if self.picture is None:
            return corners
        moved = (corners.camera == self.camera) & (corners.picture >= self.picture)
        picture = np.where(moved, corners.picture - self.jump, corners.picture)
        # Inserted pictures repeat instants that were shown before.
        kept = (picture < len(corners.pictures)) & ~(moved & (picture < self.picture))
        found = replace(corners, picture=picture).subset(kept)
        return found.ordered(np.lexsort((found.corner, found.camera, found.picture)))


def find_wand_faults(corners: CornerSet, wand: CalibrationWand) -> tuple[WandFault, ...]:
    """Find the cameras whose clocks drift, or jump since pictures were lost or inserted.

    Two cameras in step are needed: if all clocks differ, it is arbitrary against which one the others are stated.

    Args:
        corners: Points of the wand in all pictures, which follow each other at a constant rate.
        wand: The wand.

    Returns:
        The clocks, each against a camera that has none of them; none if no pair of cameras is much worse than the
        others, or no such clock explains it.
    """
    tracks = WandTracks.of(corners, wand)
    found: list[WandFault] = []
    while len(found) < tracks.cameras - 1:
        done = frozenset(each.camera for each in found)
        more = _clearest(_with_clocks(tracks, found), done)
        if more is None:
            break
        found.append(_against_even(more, found))
    # The last one was estimated beside the others.
    for each in tuple(found[:-1]):
        others = [other for other in found if other is not each]
        again = _estimated_again(tracks, each.camera, others)
        found = others if again is None else [*others, again]
    return tuple(found)


def _clearest(tracks: WandTracks, done: frozenset[int]) -> WandFault | None:
    """Return the clock of one more camera that explains most of what the pairs contradict."""
    lags = pair_lags(tracks)
    distances = {(each.first, each.second): _pair_distance(tracks, each) for each in lags}
    suspects = [each for each in _suspects(tracks.cameras, distances) if each not in done]
    found = [fault for camera in suspects for fault in _faults(tracks, camera, lags, distances)]
    good = [each for each, _ in found if each.after < _EXPLAINED * each.before]
    return _simplest(good, {id(each): total for each, total in found}) if good else None


def _simplest(good: Sequence[WandFault], whole: Mapping[int, float]) -> WandFault:
    """Return the simplest clock that is about as good as the best; pictures are lost more often than inserted."""
    least = min(whole[id(each)] for each in good)
    close = [each for each in good if whole[id(each)] * _DECISIVE <= least]
    return min(close, key=lambda each: (each.picture is None, each.jump > 0, whole[id(each)]))


def _with_clocks(tracks: WandTracks, faults: Sequence[WandFault]) -> WandTracks:
    """Return the points with those of some cameras at the instants of their partners."""
    if not faults:
        return tracks
    places, instants = tracks.places.copy(), np.arange(tracks.pictures, dtype=float)
    for each in faults:
        places[each.camera] = tracks.at(each.camera, instants + each.late)
    return WandTracks(places)


def _against_even(fault: WandFault, before: Sequence[WandFault]) -> WandFault:
    """Return a clock against a camera without a fault: the points of others are at the instants of their partners."""
    even = {each.camera: each.partner for each in before}
    return replace(fault, partner=even.get(fault.partner, fault.partner))


def _estimated_again(tracks: WandTracks, camera: int, others: Sequence[WandFault]) -> WandFault | None:
    """Estimate the clock of a camera beside the others; None if it does not improve the pairs of the camera."""
    even = _with_clocks(tracks, others)
    lags = pair_lags(even)
    distances = {(each.first, each.second): _pair_distance(even, each) for each in lags}
    found = list(_faults(even, camera, lags, distances))
    good = [each for each, _ in found if each.after < _EXPLAINED * each.before]
    return _against_even(_simplest(good, {id(each): total for each, total in found}), others) if good else None


def _pair_distance(tracks: WandTracks, pair: WandLag) -> float:
    """Return the mean distance of the points of a pair at its constant lag."""
    instants = np.arange(tracks.pictures, dtype=float)
    return _mean_distance(tracks.at(pair.first, instants), tracks.at(pair.second, instants + pair.lag))


def _mean_distance(first: Floats, second: Floats) -> float:
    """Return the geometric mean of the distances of points (K, F, 2) of two cameras from epipolar lines, each bounded.

    It shows a small drift, which changes all distances a little, as well as a loss near an end of the session, which
    changes few of them much.
    """
    known = np.isfinite(first[..., 0]) & np.isfinite(second[..., 0])
    if np.count_nonzero(known) < LEAST_COMMON_POINTS:
        return GREATEST_DISTANCE
    matrix, _ = epipolar_fit(first[known], second[known])
    apart = point_distances(matrix, first[known], second[known])
    return float(np.exp(np.log(np.clip(apart, _LEAST_DISTANCE, GREATEST_DISTANCE)).mean()))


def _suspects(cameras: int, distances: Mapping[tuple[int, int], float]) -> Iterator[int]:
    """Iterate over cameras whose pairs are worse than those of all others, or all bad."""
    for camera in range(cameras):
        own = [np.log(each) for pair, each in distances.items() if camera in pair]
        rest = [np.log(each) for pair, each in distances.items() if camera not in pair]
        worse = bool(own and rest) and np.mean(own) > np.mean(rest) + np.log(_SUSPECT)
        if worse or (own and min(own) > np.log(_SUSPECT_ALONE)):
            yield camera


def _faults(
    tracks: WandTracks, camera: int, lags: Sequence[WandLag], distances: Mapping[tuple[int, int], float]
) -> Iterator[tuple[WandFault, float]]:
    """Iterate over a drift and a jump of one camera, each with the mean distance of all pairs."""
    own = [each for each in lags if camera in (each.first, each.second)]
    rest = [each for each in lags if each not in own]
    late, group = joined_lags(tracks.cameras, [each for each in rest if each.is_clear])
    partners = [each.second if each.first == camera else each.first for each in own]
    best = np.bincount(group[partners]).argmax()
    partners = [each for each in partners if group[each] == best]
    clock = _Clock(tracks, camera, {each: float(late[each]) for each in partners})
    constants = [_late_of(each, camera, late) for each in own if clock.has(each)]
    before = min(clock.constant(each) for each in constants)
    for picture, found in ((None, clock.drifting(float(np.median(constants)))), clock.jumping(constants)):
        after = clock.distance(found)
        pairs = clock.distances(found)
        partner = min(pairs, key=lambda each: pairs[each])
        every = [np.log(after)] * len(partners) + [np.log(distances[each.first, each.second]) for each in rest]
        fault = WandFault(
            camera=camera, partner=partner, late=found - late[partner], picture=picture, before=before, after=after,
        )  # fmt: skip
        yield fault, float(np.exp(np.mean(every)))


def _late_of(pair: WandLag, camera: int, late: Floats) -> float:
    """Return by how much a camera is late, from its lag against another one."""
    return float(late[pair.first] + pair.lag if pair.second == camera else late[pair.second] - pair.lag)


@dataclass(frozen=True, eq=False)
class _Clock:
    """Distances of the points of one camera's pairs with different clocks of that camera."""

    tracks: WandTracks
    camera: int
    others: dict[int, float]
    """By how much its partners are late [pictures]."""

    def has(self, pair: WandLag) -> bool:
        """Return whether a pair is one of the camera and a partner."""
        return pair.first in self.others or pair.second in self.others

    @property
    def instants(self) -> Floats:
        """(F,)."""
        return np.arange(self.tracks.pictures, dtype=float)

    def points(self, late: Floats) -> Iterator[tuple[int, Floats, Floats]]:
        """Iterate over the partners, with the points (K, F, 2) of the camera and the partner at all instants."""
        own = self.tracks.at(self.camera, self.instants + late)
        for other, lag in self.others.items():
            yield other, own, self.tracks.at(other, self.instants + lag)

    def distance(self, late: Floats) -> float:
        """Return the mean distance of the points of all pairs if the camera is late by (F,) pictures."""
        return float(np.exp(np.mean(np.log(list(self.distances(late).values())))))

    def distances(self, late: Floats) -> dict[int, float]:
        """Return the mean distance of the points of each pair, by partner, if the camera is late by (F,) pictures."""
        return {other: _mean_distance(own, there) for other, own, there in self.points(late)}

    def constant(self, start: float) -> float:
        """Return the least distance at a constant delay near one."""
        found = scipy.optimize.minimize_scalar(
            lambda x: self.distance(np.full(len(self.instants), x)), bounds=(start - _NEAR, start + _NEAR),
            method="bounded", options={"xatol": 0.003, "maxiter": _MOST_STEPS},
        )  # fmt: skip
        return float(min(found.fun, self.distance(np.full(len(self.instants), np.round(start)))))

    def drifting(self, constant: float) -> Floats:
        """Return the delays (F,) of the best clock that drifts evenly, near a constant delay."""
        share = self.instants / max(len(self.instants) - 1, 1) - 0.5

        def line(x: Floats) -> Floats:
            return np.asarray(x[0] + x[1] * share)

        tried = [np.array([constant, end]) for end in np.arange(-_MOST_DRIFT, _MOST_DRIFT + 1)]
        start = min(tried, key=lambda x: self.distance(line(x)))
        simplex = start + np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 1.0]])
        options = {"maxfev": _MOST_STEPS, "xatol": 0.01, "fatol": 1e-3, "initial_simplex": simplex}
        found = scipy.optimize.minimize(
            lambda x: float(np.log(self.distance(line(x)))), start, method="Nelder-Mead", options=options
        )
        return line(np.asarray(found.x, float))

    def jumping(self, constants: Sequence[float]) -> tuple[int, Floats]:
        """Return the first picture after a jump and the delays (F,) of the best clock that jumps once.

        Args:
            constants: The best constant delay of each pair: that before the jump in some, that after it in others.
        """
        count = len(self.instants)
        margin = max(int(_LEAST_SIDE * count), 1)
        places = np.unique(np.linspace(margin, count - margin, _INSTANTS + 2).astype(int)[1:-1])
        steps = [k for k in range(-_MOST_JUMP, _MOST_JUMP + 1) if k]
        pairs = [each for x in {round(x) for x in constants} for k in steps for each in ((x, x + k), (x - k, x))]
        tried = [(int(place), *each) for place in places for each in pairs]
        best = min(tried, key=lambda each: self.distance(self.jump(*each)))
        picture = self.first_after(*best, reach=count // _INSTANTS)
        return picture, self.jump(picture, *best[1:])

    def jump(self, picture: int, before: int, after: int) -> Floats:
        """Return the delays (F,) of a camera of which a picture is the first after a jump; NaN where it has none."""
        early = self.instants + before < picture
        late = self.instants + after >= picture
        return np.where(early, float(before), np.where(late, float(after), np.nan))

    def first_after(self, picture: int, before: int, after: int, *, reach: int) -> int:
        """Return the picture from which on the points fit better after a jump than before it, near a first guess."""
        cost = np.zeros((2, len(self.instants)))
        start = self.jump(picture, before, after)
        for _, own, there in self.points(start):
            known = np.isfinite(own[..., 0]) & np.isfinite(there[..., 0])
            matrix, usual = epipolar_fit(own[known], there[known])
            for side, late in enumerate((before, after)):
                moved = self.tracks.at(self.camera, self.instants + late)
                apart = np.minimum(point_distances(matrix, moved, there), 10.0 * usual)
                cost[side] += np.nan_to_num(apart).sum(axis=0)
        tried = np.arange(max(picture - reach, 1), min(picture + reach, len(self.instants) - 1))
        totals = []
        for each in tried:
            early, shown = self.instants + before < each, self.instants + after >= each
            totals.append(cost[0, early].sum() + cost[1, shown & ~early].sum())
        return int(tried[int(np.argmin(totals))])
