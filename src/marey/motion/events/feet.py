"""Paths of the feet of a person who walks or runs, and what the detection of gait events derives from them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

from marey.arrays import Floats, Mask, freeze_fields, true_runs
from marey.errors import MareyError
from marey.motion.filters import MINIMUM_RATE_RATIO, low_pass

_FINE_HZ = 240.0
"""Smallest rate at which events are searched [Hz]: slower paths are interpolated by cubic splines. Extremes are placed
within half a sample of it, 2 ms, 10 % of the error of the methods (docs/accuracy/markers.md)."""
_DEGREE = 5
"""Degree of the splines from which accelerations follow. Those of cubic splines have corners at the frames, where
strikes then lie: with a part of the frames of the walks with force plates, at 24 to 30 Hz, strikes scatter by 5 to 7 ms
with this degree and by 9 to 15 ms with cubic splines. Cubic ones are taken for places and velocities, as they swing
less at the ends."""
_SHORTEST_S = 0.3
"""Shortest section without gaps in which events are searched [s]; a swing takes about 0.4 s."""
_DIRECTION_S = 1.0
"""Length of the window over which the direction of progression is estimated [s]: about a cycle, in which the swaying of
the body cancels, and in which a person turns by no more than about 90 degrees."""
_STANDING_SHARE = 0.3
"""Share of the frames, the lowest ones, in which heel or toe stand: 0.4 of the cycle in a walk, 0.3 in a run."""
_MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable."""
_SLOWEST = 0.25
"""Slowest progression of the body over ground that has a direction of its own [m/s]; a slower one is on a treadmill,
or a turn in place, and its direction is that of the feet. Slow walking is faster than 0.4 m/s, swaying on a treadmill
over `_DIRECTION_S` slower than 0.1 m/s."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FootPath:
    """The path of one foot."""

    side: str | None
    """`left`, `right`, or None if unknown."""
    heel: Floats
    """(F, 3) a point at the heel, Z up [m]; NaN where missing."""
    toe: Floats | None = None
    """(F, 3) a point at the front of the foot, Z up [m]; None if there is none."""

    def __post_init__(self) -> None:
        freeze_fields(self, "heel", *(() if self.toe is None else ("toe",)))


@dataclass(frozen=True, eq=False, kw_only=True)
class WalkPaths:
    """Paths of the feet and of the body of one person."""

    body: Floats
    """(F, 3) a point that moves with the pelvis, Z up [m]; NaN where missing."""
    feet: tuple[FootPath, ...]
    """One or two feet."""
    rate: float
    """Frames per second [Hz]."""
    start_s: float = 0.0
    """Time of the first frame [s]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "body")
        wrong = [foot.side for foot in self.feet if len(foot.heel) != len(self.body)]
        if wrong:
            raise MareyError("The paths of the feet and of the body have different numbers of frames.")

    @property
    def time(self) -> Floats:
        """(F,) [s]."""
        return self.start_s + np.arange(len(self.body)) / self.rate


class FineFoot(NamedTuple):
    """One foot over a section without gaps, at N instants of a fine time base, in metres and seconds."""

    side: str | None
    """`left`, `right`, or None if unknown."""
    time: Floats
    """(N,) [s]."""
    ahead: Floats
    """(N, 3) horizontal unit vector in the direction of progression."""
    heel: "PointCourse"
    """The heel."""
    toe: "PointCourse | None"
    """The front of the foot."""
    body: Floats
    """(N, 3) [m]."""
    noise_m: float
    """Standard deviation of the noise of heel and toe along one axis, while the foot stands [m]."""

    @property
    def reach(self) -> Floats:
        """(N,) how far the heel is ahead of the body [m]."""
        return np.asarray(((self.heel.place - self.body) * self.ahead).sum(1))

    @property
    def front(self) -> "PointCourse":
        """The front of the foot, or the heel if there is no point there."""
        return self.heel if self.toe is None else self.toe

    def along(self, vectors: Floats, window: slice = slice(None)) -> Floats:
        """Return the components of vectors (N, 3) in the direction of progression, at the instants of a window."""
        return np.asarray((vectors[window] * self.ahead[window]).sum(1))


class PointCourse(NamedTuple):
    """A point over N instants, its velocity and acceleration relative to the ground or the belt beneath it."""

    place: Floats
    """(N, 3) [m]."""
    velocity: Floats
    """(N, 3) [m/s]."""
    acceleration: Floats
    """(N, 3) [m/s^2]."""
    speed: Floats
    """(N,) length of the velocity [m/s]."""


def direction_of_progression(paths: WalkPaths) -> Floats:
    """Estimate the direction of progression in every frame, over windows of about a cycle.

    Over ground it is that of the body's motion; where the body stays in place, on a treadmill or in a turn, it is the
    mean direction from heel to toe of the feet, or, without toes, that of the feet's fast motion.

    Args:
        paths: The feet and the body.

    Returns:
        (F, 3) horizontal unit vectors; NaN where neither is known.
    """
    velocity = _mean_velocity(paths)
    moving = np.linalg.norm(velocity, axis=1) > _SLOWEST
    toward = np.where(moving[:, None], velocity, _forward_of_feet(paths))
    with np.errstate(invalid="ignore"):
        return np.asarray(toward / np.linalg.norm(toward, axis=1, keepdims=True))


def _half_window(paths: WalkPaths) -> int:
    return max(1, round(0.5 * _DIRECTION_S * paths.rate))


def _mean_velocity(paths: WalkPaths) -> Floats:
    """Return the body's horizontal velocity (F, 3) over a window about each frame [m/s], shorter at the ends."""
    place = paths.body * [1.0, 1.0, 0.0]
    known = np.flatnonzero(np.isfinite(place).all(1))
    if len(known) < 2:
        return np.full(place.shape, np.nan)
    frames, half = np.arange(len(place)), _half_window(paths)
    last = known[np.searchsorted(known, np.clip(frames + half, known[0], known[-1]), side="right") - 1]
    first = known[np.searchsorted(known, np.clip(frames - half, known[0], known[-1]))]
    seconds = np.maximum(last - first, 1) / paths.rate
    return np.asarray((place[last] - place[first]) / seconds[:, None])


def ground_velocity(paths: WalkPaths) -> Floats:
    """Estimate the velocity (3,) of what the feet stand on [m/s]: zero over ground, that of the belt on a treadmill.

    A body that moves walks over ground. Otherwise the front of each foot is lowest while it stands, with the velocity
    of the belt.
    """
    speed = np.linalg.norm(_mean_velocity(paths), axis=1)
    if np.isfinite(speed).any() and np.nanmedian(speed) > _SLOWEST:
        return np.zeros(3)
    standing = []
    for foot in paths.feet:
        place = foot.heel if foot.toe is None else foot.toe
        if np.isfinite(place[:, 2]).any() and len(place) > 1:
            low = place[:, 2] <= np.nanquantile(place[:, 2], _STANDING_SHARE)
            standing.append(np.gradient(place, 1 / paths.rate, axis=0)[low])
    moving = np.concatenate(standing) if standing else np.zeros((0, 3))
    moving = moving[np.isfinite(moving).all(1)]
    return np.asarray(np.median(moving, axis=0) * [1.0, 1.0, 0.0]) if len(moving) else np.zeros(3)


def _forward_of_feet(paths: WalkPaths) -> Floats:
    """Return the direction (F, 3) in which the feet point or, without toes, in which they swing."""
    flat = np.array([1.0, 1.0, 0.0])
    toes = [(foot.toe - foot.heel) * flat for foot in paths.feet if foot.toe is not None]
    if toes:
        with np.errstate(invalid="ignore"):
            each = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in toes]
        return _mean_over(np.nansum(each, 0), _half_window(paths))
    swinging = np.zeros(3)
    for foot in paths.feet:
        relative = ((foot.heel - paths.body) * flat)[np.isfinite(foot.heel + paths.body).all(1)]
        if len(relative) > 2:
            axis = np.linalg.svd(relative - relative.mean(0), full_matrices=False)[2][0]
            # The foot moves back slowly, with the belt or the body, and swings forward fast.
            swinging += axis * np.sign((np.diff(relative @ axis) ** 3).sum())
    return np.broadcast_to(swinging, paths.body.shape)


def _mean_over(values: Floats, half: int) -> Floats:
    """Return the mean of values (F, K) from `half` frames before to `half` frames after each frame."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    frames = np.arange(len(values))
    first, last = np.maximum(frames - half, 0), np.minimum(frames + half + 1, len(values))
    return np.asarray((total[last] - total[first]) / (last - first)[:, None])


def fine_feet(paths: WalkPaths, *, cutoff_hz: float) -> Iterator[FineFoot]:
    """Yield each foot in each section without gaps, smoothed and on a fine time base.

    Args:
        paths: The feet and the body.
        cutoff_hz: Cut-off of the low-pass filter [Hz]; paths of less than 2.2 times this rate are not filtered.

    Yields:
        Sections of at least 0.3 s.
    """
    ahead, ground = direction_of_progression(paths), ground_velocity(paths)
    for foot in paths.feet:
        points = [foot.heel, paths.body, ahead, *([] if foot.toe is None else [foot.toe])]
        known: Mask = np.asarray(np.isfinite(np.concatenate(points, 1)).all(1))
        for start, end in true_runs(known):
            if end - start >= max(_DEGREE + 1, _SHORTEST_S * paths.rate):
                yield _fine(paths, foot, ahead, ground, slice(start, end), cutoff_hz)


def _fine(
    paths: WalkPaths, foot: FootPath, ahead: Floats, ground: Floats, frames: slice, cutoff_hz: float
) -> FineFoot:  # fmt: skip
    time = paths.time[frames]
    steps = int(np.ceil(_FINE_HZ / paths.rate))
    fine = np.linspace(time[0], time[-1], (len(time) - 1) * steps + 1)
    heel = smooth_path(foot.heel[frames], paths.rate, cutoff_hz)
    toe = None if foot.toe is None else smooth_path(foot.toe[frames], paths.rate, cutoff_hz)
    toward = CubicSpline(time, ahead[frames])(fine)
    measured = [foot.heel[frames], *([] if foot.toe is None else [foot.toe[frames]])]
    return FineFoot(
        side=foot.side, time=fine, body=CubicSpline(time, paths.body[frames])(fine),
        heel=_course(time, heel, fine, ground), toe=None if toe is None else _course(time, toe, fine, ground),
        ahead=toward / np.linalg.norm(toward, axis=1, keepdims=True), noise_m=max(map(noise_of_path, measured)),
    )  # fmt: skip


def noise_of_path(points: Floats) -> float:
    """Estimate the noise of a path (F, 3) [m] from its second differences while it is low: then the foot stands."""
    low = points[1:-1, 2] <= np.quantile(points[:, 2], _STANDING_SHARE)
    bends = np.diff(points, 2, axis=0)[low]
    return float(np.median(np.abs(bends)) / (_MEDIAN_OF_NORMAL * np.sqrt(6)))


def smooth_path(points: Floats, rate: float, cutoff_hz: float) -> Floats:
    """Remove noise that would cause false extremes, if the rate allows it."""
    return points if rate < MINIMUM_RATE_RATIO * cutoff_hz else low_pass(points, rate=rate, cutoff_hz=cutoff_hz)


def _course(time: Floats, points: Floats, fine: Floats, ground: Floats) -> PointCourse:
    """Return a path on the fine time base."""
    path, bends = CubicSpline(time, points), make_interp_spline(time, points, k=_DEGREE)
    velocity = path(fine, 1) - ground
    return PointCourse(
        place=path(fine), velocity=velocity, acceleration=bends(fine, 2), speed=np.linalg.norm(velocity, axis=1)
    )
