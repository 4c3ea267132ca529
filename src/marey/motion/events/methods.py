"""Published methods that find foot strikes and foot offs from the motion of heel and toe.

Every method places one strike near each most anterior position of the heel relative to the body, and one off near each
most posterior position of the toe. Unlike the papers, which search the whole trial, all methods share these extremes,
so that they differ in the time of an event and not in the number of events.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Mask
from marey.motion.events.feet import FineFoot, PointCourse

_LEAST_REVERSAL = 0.4
"""Smallest reversal of the foot's motion relative to the body between two extremes, as a ratio to its range. Chosen by
hand: smaller ones are shuffling in place."""
_EDGE_REVERSAL = 0.05
"""The same between an extreme and the end of the section, where less of the motion is seen. Chosen by hand."""
_OPEN_SHARE = 0.8
"""Share of its range that a foot has moved back when a section ends with an off, or will move when it begins with a
strike: 0.9 in the rendered walks, 0.5 in the middle of stance."""
_SMALLEST_RANGE_M = 0.15
"""Smallest range of the foot's motion relative to the body in a walk [m]. Chosen by hand; the steps of slow walking
reach about 0.3 m."""
_STRIKE_WINDOW = (0.05, 0.40)
"""A strike lies within these ratios of a swing's duration before and after the most anterior position: in the trials
with force plates and true feet it follows by 20 to 75 ms, 0.05 to 0.2 swings."""
_OFF_WINDOW = (0.40, 0.35)
"""The same for the off and the most posterior position: it lies up to 85 ms before that position."""
_TYPICAL_SWING_S = 0.45
"""Duration of a swing where none is complete [s]; 0.3 s in running, 0.6 s in slow walking."""
_NEAR_LOWEST = 0.2
"""A local minimum of the heel's height counts as the strike when it lies within this ratio of the descent above the
lowest position. Chosen by hand."""
_STANDING_SPEED = 0.5
"""Speed below which a point of the foot stands [m/s]. [Ghoussayni2004] use 0.05 m/s, which captured feet at 30 Hz
exceed in stance; the feet of the rendered walks move at up to 0.41 m/s before they leave the floor."""
_CREEPING_SPEED = 0.1
"""Speed of a toe in stance [m/s]: those of the rendered walks creep at up to 0.13 m/s, those with force plates at less
than 0.1 m/s."""
_LEAVING_SPEED = 1.0
"""Speed that the toe exceeds only once it leaves the floor [m/s]: the second point of the line that `onset`
extrapolates, twice the first."""
_TOE_FIRST_S = 0.02
"""Time by which the front of a foot must stop before its heel to land first [s]. Chosen by hand: in the walks with
truth the front stops 1 to 105 ms after the heel."""
_HEEL_LOWERED_M = 0.01
"""Descent of the heel after the front of the foot has stopped, from which on the front landed first [m]. Chosen by
hand: 3 degrees of a foot."""
_FRONT_SHARE = 0.5
"""Largest descent of the front meanwhile, as a ratio to that of the heel; both descend where the whole foot still
sinks. Chosen by hand."""
_LIFTED_M = 0.010
"""Height above its place in stance from which on a toe has left the floor [m]. Chosen by hand."""


class Swing(NamedTuple):
    """A part of a section in which one event is searched."""

    extreme: int
    """Instant of the extreme."""
    window: slice
    """Instants among which the event lies."""


class Extremes(NamedTuple):
    """Where strikes and offs are searched in a section."""

    strikes: tuple[Swing, ...]
    """Near the most anterior positions of the heel."""
    offs: tuple[Swing, ...]
    """Near the most posterior positions of the toe."""


def find_extremes(foot: FineFoot) -> Extremes:
    """Find the extremes of a foot's motion relative to the body, and the windows about them.

    Args:
        foot: A section without gaps.

    Returns:
        The extremes; none if the foot does not swing.
    """
    behind = foot.along(foot.front.place - foot.body)
    anterior = [k for k, top in turning_points(foot.reach) if top]
    posterior = [k for k, top in turning_points(behind) if not top]
    if _starts_with_strike(foot):
        anterior.insert(0, 0)
    if _ends_with_off(foot, behind):
        posterior.append(len(foot.time) - 1)
    step = foot.time[1] - foot.time[0]
    swings = [min((a - p for a in anterior if a > p), default=0) for p in posterior]
    typical = np.median([s for s in swings if s] or [_TYPICAL_SWING_S / step])
    count = len(foot.time)

    def about(k: int, ratios: tuple[float, float]) -> Swing:
        before, after = (round(ratio * typical) for ratio in ratios)
        return Swing(k, slice(max(0, k - before), min(count, k + after + 1)))

    return Extremes(
        tuple(about(k, _STRIKE_WINDOW) for k in anterior), tuple(about(k, _OFF_WINDOW) for k in posterior)
    )  # fmt: skip


def _starts_with_strike(foot: FineFoot) -> bool:
    """Return whether a section begins between the most anterior position and the strike.

    The foot begins near its most anterior position, still moves, and then goes back until it is most posterior.
    """
    turns = turning_points(foot.reach)
    far = bool(turns) and not turns[0][1] and _is_most_of_range(foot.reach, foot.reach[0] - foot.reach[turns[0][0]])
    return far and bool(foot.heel.speed[0] > _STANDING_SPEED)


def _ends_with_off(foot: FineFoot, behind: Floats) -> bool:
    """Return whether a section ends between the off and the most posterior position, with a toe that moves."""
    turns = turning_points(behind)
    far = bool(turns) and turns[-1][1] and _is_most_of_range(behind, behind[turns[-1][0]] - behind[-1])
    return far and bool(foot.front.speed[-1] > _STANDING_SPEED)


def _is_most_of_range(values: Floats, part: float) -> bool:
    return bool(part > _OPEN_SHARE * (np.percentile(values, 98) - np.percentile(values, 2)))


def turning_points(values: Floats) -> list[tuple[int, bool]]:
    """List the alternating maxima (True) and minima (False) of a curve (N,) between large reversals."""
    span = float(np.percentile(values, 98) - np.percentile(values, 2))
    if span < _SMALLEST_RANGE_M:
        return []
    ends, edge = {0, len(values) - 1}, _EDGE_REVERSAL * span
    return [
        (k, top) for k, top in reversals(values, _LEAST_REVERSAL * span)
        if k not in ends and _reverses(values, k, top, edge)
    ]  # fmt: skip


def reversals(values: Floats, least: float) -> list[tuple[int, bool]]:
    """List the alternating maxima (True) and minima (False) of a curve, from its first to its last large extreme.

    Args:
        values: (N,) the curve.
        least: Difference between neighbouring extremes from which on they count.

    Returns:
        Indices of the extremes, which may be the ends of the curve; none of a curve within `least`.
    """
    found: list[tuple[int, bool]] = []
    low = high = 0
    rising: bool | None = None
    course = values.tolist()  # its numbers are read one by one, faster than those of an array
    for k, value in enumerate(course):
        low = k if value < course[low] else low
        high = k if value > course[high] else high
        if rising is not False and value < course[high] - least:
            found.append((high, True))
            rising, low = False, k
        elif rising is not True and value > course[low] + least:
            found.append((low, False))
            rising, high = True, k
    if rising is not None:  # the last extreme may lie near the end
        found.append((high, True) if rising else (low, False))
    return found


def _reverses(values: Floats, k: int, top: bool, edge: float) -> bool:
    """Return whether a curve moves away from an extreme on both sides."""
    sign = 1.0 if top else -1.0
    return bool(min(np.max(sign * (values[k] - part)) for part in (values[: k + 1], values[k:])) >= edge)


def landing_point(foot: FineFoot, swing: Swing) -> FineFoot:
    """Return a foot whose heel is the point that lands first: the front of the foot, if it stops and the heel follows.

    So land feet on stairs, in running on the forefoot, and in an equinus gait. The strike is then the impact of the
    front, as that of the heel is otherwise.

    Args:
        foot: A section without gaps.
        swing: The swing before the strike.
    """
    if foot.toe is None:
        return foot
    by_front, by_heel = (_stop(point, foot.time, swing) for point in (foot.toe, foot.heel))
    if not (np.isfinite(by_front) and by_front < by_heel - _TOE_FIRST_S):
        return foot
    front, heel = (_descent(point, foot.time, swing, by_front) for point in (foot.toe, foot.heel))
    return foot._replace(heel=foot.toe) if heel > _HEEL_LOWERED_M and front < _FRONT_SHARE * heel else foot


def _descent(point: PointCourse, time: Floats, swing: Swing, start: float) -> float:
    """Return by how much a point is lower at the end of a window than at some time in it [m]."""
    height = point.place[swing.window, 2]
    return float(np.interp(start, time[swing.window], height) - height[-1])


def _stop(point: PointCourse, time: Floats, swing: Swing) -> float:
    """Return when the speed of a point falls below a threshold for the last time in a window.

    Infinite, with its sign, if the point still moves at the end of the window, or does not move in it.
    """
    speed = point.speed[swing.window]
    fast = speed > _STANDING_SPEED
    if fast[-1] or not fast.any():
        return float("inf") if fast[-1] else float("-inf")
    return _crossing(time[swing.window], speed - _STANDING_SPEED, last=fast)


def _zeni_strike(foot: FineFoot, swing: Swing) -> float:
    """Return when the heel is farthest ahead of the body ([Zeni2008])."""
    return float(foot.time[swing.extreme])


def _zeni_off(foot: FineFoot, swing: Swing) -> float:
    """Return when the toe is farthest behind the body ([Zeni2008])."""
    return float(foot.time[swing.extreme])


def _oconnor_strike(foot: FineFoot, swing: Swing) -> float:
    """Return when the centre of the foot moves downward fastest ([OConnor2007])."""
    return _at(foot, swing, int(np.argmin(_centre_velocity(foot, swing.window))))


def _oconnor_off(foot: FineFoot, swing: Swing) -> float:
    """Return when the centre of the foot moves upward fastest ([OConnor2007])."""
    return _at(foot, swing, int(np.argmax(_centre_velocity(foot, swing.window))))


def _centre_velocity(foot: FineFoot, window: slice) -> Floats:
    return 0.5 * (foot.heel.velocity[window, 2] + foot.front.velocity[window, 2])


def _hreljac_strike(foot: FineFoot, swing: Swing) -> float:
    """Return when the heel's upward acceleration has its largest maximum ([Hreljac2000])."""
    return _largest_peak(foot.time[swing.window], foot.heel.acceleration[swing.window, 2])


def _hreljac_off(foot: FineFoot, swing: Swing) -> float:
    """Return when the toe's forward acceleration has its largest maximum ([Hreljac2000])."""
    return _largest_peak(foot.time[swing.window], foot.along(foot.front.acceleration, swing.window))


def _ghoussayni_strike(foot: FineFoot, swing: Swing) -> float:
    """Return when the heel's speed falls below a threshold ([Ghoussayni2004])."""
    fast = foot.heel.speed[swing.window] > _STANDING_SPEED
    return _crossing(foot.time[swing.window], foot.heel.speed[swing.window] - _STANDING_SPEED, last=fast)


def _ghoussayni_off(foot: FineFoot, swing: Swing) -> float:
    """Return when the toe's speed rises above a threshold for the last time ([Ghoussayni2004])."""
    slow = foot.front.speed[swing.window] <= _STANDING_SPEED
    return _crossing(foot.time[swing.window], _STANDING_SPEED - foot.front.speed[swing.window], last=slow)


def _onset_off(foot: FineFoot, swing: Swing) -> float:
    """Return when the toe starts to move: its speed between two thresholds, extrapolated to that in stance.

    Unlike [Ghoussayni2004], who use one threshold: toes that slide before they are lifted pass it late relative to the
    lift, those that are lifted with a roll pass it early, and the slope of the speed shows which of both it is.
    """
    if swing.extreme == len(foot.time) - 1:
        return float("nan")  # the section ends before the speed has risen
    time, speed = foot.time[swing.window], foot.front.speed[swing.window]
    slow, fast = (
        _crossing(time, limit - speed, last=speed <= limit) for limit in (_STANDING_SPEED, _LEAVING_SPEED)
    )  # fmt: skip
    return slow - (fast - slow) * (_STANDING_SPEED - _CREEPING_SPEED) / (_LEAVING_SPEED - _STANDING_SPEED)


def _lowest_heel(foot: FineFoot, swing: Swing) -> float:
    """Return when the heel is lowest after its most anterior position."""
    height = foot.heel.place[swing.extreme : swing.window.stop, 2]
    low = float(height.min())
    turns = np.flatnonzero((height[1:-1] <= height[:-2]) & (height[1:-1] < height[2:])) + 1
    near = [n for n in turns if height[n] - low <= _NEAR_LOWEST * (height[0] - low)]
    n = near[0] if near else int(np.argmin(height))
    inside = 0 < n < len(height) - 1
    return float(foot.time[swing.extreme + n]) if inside else np.nan


def _lifted_toe(foot: FineFoot, swing: Swing) -> float:
    """Return when the toe has risen from its lowest position."""
    height = foot.front.place[swing.window, 2]
    lowest = int(np.argmin(height))
    raised = np.flatnonzero(height[lowest:] > height[lowest] + _LIFTED_M)
    return _at(foot, swing, lowest + int(raised[0])) if len(raised) else np.nan


def _at(foot: FineFoot, swing: Swing, index: int) -> float:
    """Return the time of an extreme inside a window; NaN for one at its ends, which is no extreme."""
    count = swing.window.stop - swing.window.start
    return float(foot.time[swing.window][index]) if 0 < index < count - 1 else np.nan


def _largest_peak(time: Floats, values: Floats) -> float:
    """Return the time of the largest local maximum inside a window; NaN without one."""
    peaks = np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1
    return float(time[peaks[np.argmax(values[peaks])]]) if len(peaks) else float("nan")


def _crossing(time: Floats, excess: Floats, *, last: Mask) -> float:
    """Return when a curve falls below zero for the last time; NaN if it does not."""
    above = np.flatnonzero(last)
    if not len(above) or above[-1] == len(excess) - 1:
        return float("nan")
    k = above[-1]
    part = excess[k] / (excess[k] - excess[k + 1])
    return float(time[k] + part * (time[k + 1] - time[k]))


Placement = Callable[[FineFoot, Swing], float]
"""Places one event [s]; NaN if the method does not find it."""

STRIKE_METHODS: dict[str, Placement] = {
    "zeni": _zeni_strike, "oconnor": _oconnor_strike, "hreljac": _hreljac_strike, "ghoussayni": _ghoussayni_strike,
    "lowest heel": _lowest_heel,
}  # fmt: skip
"""Methods that place foot strikes, by name."""
OFF_METHODS: dict[str, Placement] = {
    "zeni": _zeni_off, "oconnor": _oconnor_off, "hreljac": _hreljac_off, "ghoussayni": _ghoussayni_off,
    "lifted toe": _lifted_toe, "onset": _onset_off,
}  # fmt: skip
"""Methods that place foot offs, by name."""
