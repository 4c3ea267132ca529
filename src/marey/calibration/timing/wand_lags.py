"""By how many pictures cameras are late, from the points of a wand alone, before anything is known of the cameras.

At the same instant the points that two cameras see satisfy one epipolar constraint ([Hartley1997]), whatever their
lenses and poses are. At a wrong lag, no fundamental matrix explains most of them. The lag counts at which the median
distance of the points from their epipolar lines is least, first in whole pictures, then between them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.interpolate import CubicSpline

from marey.arrays import Floats, Integers, Mask
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationWand
from marey.calibration.timing.epipolar_fit import epipolar_fit
from marey.calibration.timing.image_paths import LEAST_RUN

_MOST_LAG = 60
"""Largest lag that is searched [pictures]: six seconds at the usual ten pictures per second. Chosen by hand."""
_NEIGHBOURS = 2
"""Distance up to which lags are neighbours [pictures]: a wand moves evenly for a moment. Chosen by hand."""
LEAST_COMMON_POINTS = 40
"""Least number of common points at which a lag is tried: five times the eight that determine a fundamental matrix."""
_SYNCHRONOUS = 0.004
"""Median distance from epipolar lines up to which no other lag than a neighbour of zero is searched, in longer sides of
the image; chosen by hand."""
GREATEST_DISTANCE = 0.008
"""Greatest median distance at which a lag counts, in longer sides of the image; chosen by hand."""
_SMALLER = 0.5
"""Factor to which a lag must reduce the median distance from that at all lags that are no neighbours; by hand."""
_FINE = np.arange(-1.0, 1.01, 0.125)
"""Distances from the best whole lag that are tried [pictures]."""
_WHOLE = 1e-9
"""Distance from a whole number of pictures up to which nothing is interpolated [pictures]: rounding only."""
_SAME_CLOCK = 0.15
"""Difference of lags up to which cameras count as synchronous here [pictures]; what is left is estimated later. By
hand."""


@dataclass(frozen=True, kw_only=True)
class WandLag:
    """The lag at which two cameras see the points of a wand on epipolar lines."""

    first: int
    second: int
    lag: float
    """By how much the second is later than the first [pictures]."""
    distance: float
    """Median distance of the points from their epipolar lines, in longer sides of the image."""
    elsewhere: float
    """The smallest at any lag that is no neighbour; infinite where none was tried."""
    points: int

    @property
    def is_clear(self) -> bool:
        """Whether the lag can be used."""
        return self.distance < GREATEST_DISTANCE and self.distance < _SMALLER * self.elsewhere


@dataclass(frozen=True, eq=False, kw_only=True)
class StartClocks:
    """By how much cameras are late, before the first solution."""

    late: Floats
    """(C,) [pictures]; zero for cameras of the most common clock, and for those of which nothing is known."""
    group: Integers
    """(C,) cameras whose lags are known relative to each other have equal numbers."""


def find_wand_lags(corners: CornerSet, wand: CalibrationWand) -> StartClocks:
    """Find cameras whose pictures are late or early.

    Args:
        corners: Points of the wand in all pictures, which follow each other at a constant rate; if its ends look alike,
            they may be exchanged.
        wand: The wand.

    Returns:
        The delays, with lags between cameras of one clock taken as zero.
    """
    lags = [each for each in pair_lags(WandTracks.of(corners, wand)) if each.is_clear]
    late, group = joined_lags(len(corners.cameras), lags)
    for each in np.unique(group):
        own = np.flatnonzero(group == each)
        late[own] = from_common_clock(late[own], np.full(len(own), _SAME_CLOCK))
    return StartClocks(late=np.where(np.abs(late) < _SAME_CLOCK, 0.0, late), group=group)


@dataclass(frozen=True, eq=False)
class WandTracks:
    """The points of a wand in the images of all cameras."""

    places: Floats
    """(C, K, F, 2) from the middle of the image, in its longer sides; NaN if unseen."""

    @staticmethod
    def of(corners: CornerSet, wand: CalibrationWand) -> "WandTracks":
        """Return the points, or, of two ends that look alike, their middle, which hardly depends on the view."""
        marks = int(corners.corner.max(initial=0)) + 1
        size = np.array(corners.sizes, float)
        place = (corners.pixels - 0.5 * size[corners.camera]) / size.max(axis=1)[corners.camera, None]
        found = np.full((len(size), marks, len(corners.pictures), 2), np.nan)
        found[corners.camera, corners.corner, corners.picture] = place
        middle = wand.alike and len(wand.points) == 2
        return WandTracks(found.mean(axis=1, keepdims=True) if middle else found)

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.places)

    @property
    def pictures(self) -> int:
        """Number of pictures."""
        return int(self.places.shape[2])

    @cached_property
    def splines(self) -> tuple[tuple[tuple[int, int, CubicSpline], ...], ...]:
        """The runs of consecutive pictures of each camera: point, first picture, and spline."""
        return tuple(tuple(_track_splines(own)) for own in self.places)

    def at(self, camera: int, picture: Floats) -> Floats:
        """Return the points (K, F, 2) of a camera at pictures (F,), also between them; NaN where they are not known."""
        whole = np.round(np.nan_to_num(picture, nan=-1.0)).astype(int)
        inside = (whole >= 0) & (whole < self.pictures)
        if (np.abs(picture - whole)[inside & np.isfinite(picture)] < _WHOLE).all():
            found = self.places[camera][:, np.where(inside, whole, 0)].copy()
            found[:, ~inside] = np.nan
            return np.asarray(found)
        found = np.full((self.places.shape[1], len(picture), 2), np.nan)
        for mark, start, spline in self.splines[camera]:
            own = (picture >= start) & (picture <= start + len(spline.x) - 1)
            found[mark, own] = spline(picture[own] - start)
        return found


def pair_lags(tracks: WandTracks) -> list[WandLag]:
    """Return the lag of each pair of cameras that share points, whether it is clear or not.

    Args:
        tracks: The points of all cameras.
    """
    pairs = combinations(range(tracks.cameras), 2)
    return [found for pair in pairs if (found := _pair_lag(tracks.places, *pair)) is not None]


def from_common_clock(late: Floats, tolerance: Floats) -> Floats:
    """Return delays relative to the clock that most cameras share.

    Args:
        late: (n,) by how much cameras are late [pictures].
        tolerance: (n,) differences up to which two clocks are the same [pictures]; the larger of two counts.

    Returns:
        (n,); of clocks that equally many cameras share, that of the first camera counts. The delay of that camera is
        zero.
    """
    near = np.abs(late[:, None] - late) < np.maximum(tolerance[:, None], tolerance)
    return np.asarray(late - late[int(np.argmax(near.sum(axis=1)))])


def _pair_lag(tracks: Floats, first: int, second: int) -> WandLag | None:
    """Return the lag of the second camera that explains the points best; None if none can be tried."""
    most = min(_MOST_LAG, tracks.shape[2] // 4)
    near, found = range(-_NEIGHBOURS, _NEIGHBOURS + 1), dict[int, tuple[float, int]]()
    for lag in (*near, *(k for k in range(-most, most + 1) if k not in near)):
        if abs(lag) > _NEIGHBOURS and min((each for each, _ in found.values()), default=1.0) < _SYNCHRONOUS:
            break
        a, b = _common_points(tracks[first], tracks[second], lag)
        if len(a) >= LEAST_COMMON_POINTS:
            found[lag] = _epipolar_distance(a, b), len(a)
    if not found:
        return None
    lag = min(found, key=lambda each: found[each][0])
    others = [each for k, (each, _) in found.items() if abs(k - lag) > _NEIGHBOURS]
    fine, distance = _finer(tracks[first], tracks[second], lag)
    return WandLag(
        first=first, second=second, lag=fine, distance=min(distance, found[lag][0]), points=found[lag][1],
        elsewhere=min(others, default=np.inf),
    )  # fmt: skip


def _common_points(first: Floats, second: Floats, lag: int) -> tuple[Floats, Floats]:
    """Return the points (n, 2) that two cameras show at the same instants if the second is late by a lag."""
    count = first.shape[1]
    a = first[:, max(0, -lag) : count - max(0, lag)].reshape(-1, 2)
    b = second[:, max(0, lag) : count - max(0, -lag)].reshape(-1, 2)
    known = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    return a[known], b[known]


def _finer(first: Floats, second: Floats, lag: int) -> tuple[float, float]:
    """Return the best lag between pictures near a whole one, and the median distance of the points there."""
    splines = list(_track_splines(second))
    distance = np.full(len(_FINE), np.inf)
    for k, more in enumerate(_FINE):
        a, b = [np.zeros((0, 2))], [np.zeros((0, 2))]
        for mark, start, spline in splines:
            at = np.arange(len(spline.x) - 1) + float(lag + more) % 1.0
            instant = np.round(start + at - lag - more).astype(int)
            good = (instant >= 0) & (instant < first.shape[1]) & (at <= len(spline.x) - 1)
            own = first[mark, instant[good]]
            known = np.isfinite(own[:, 0])
            a.append(own[known])
            b.append(spline(at[good][known]))
        one, two = np.concatenate(a), np.concatenate(b)
        if len(one) >= LEAST_COMMON_POINTS:
            distance[k] = _epipolar_distance(one, two)
    best = int(np.argmin(distance))
    if not np.isfinite(distance[best]):
        return float(lag), np.inf
    return float(lag + _FINE[best] + _vertex(distance, best)), float(distance[best])


def _vertex(values: Floats, best: int) -> float:
    """Return how far the minimum of a parabola lies from the least of equally distant values, in their units."""
    if not 0 < best < len(values) - 1 or not np.isfinite(values[best - 1 : best + 2]).all():
        return 0.0
    low, middle, high = values[best - 1 : best + 2]
    bend = low - 2.0 * middle + high
    return float((_FINE[1] - _FINE[0]) * 0.5 * (low - high) / bend) if bend > 0 else 0.0


def _track_splines(track: Floats) -> Iterator[tuple[int, int, CubicSpline]]:
    """Iterate over the runs of consecutive pictures of each point (K, F, 2): point, first picture, and spline."""
    for mark, places in enumerate(track):
        seen = np.flatnonzero(np.isfinite(places[:, 0]))
        for run in np.split(seen, np.flatnonzero(np.diff(seen) != 1) + 1):
            if len(run) >= LEAST_RUN:
                yield mark, int(run[0]), CubicSpline(np.arange(len(run)), places[run])


def _epipolar_distance(first: Floats, second: Floats) -> float:
    return epipolar_fit(first, second)[1]


def joined_lags(cameras: int, lags: Sequence[WandLag]) -> tuple[Floats, Integers]:
    """Return by how much each camera is late in its group, and the groups, from the clearest lags on.

    Args:
        cameras: Number of cameras C.
        lags: Clear lags of pairs.

    Returns:
        (C,) delays [pictures], and (C,) groups.
    """
    late, group = np.zeros(cameras), np.arange(cameras)
    for each in sorted(lags, key=lambda each: each.distance / np.sqrt(each.points)):
        a, b = group[each.first], group[each.second]
        if a != b:
            moved: Mask = group == b
            late[moved] += late[each.first] + each.lag - late[each.second]
            group[moved] = a
    return late, group
