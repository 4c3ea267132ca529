"""Spatio-temporal parameters of each gait cycle, with standard deviations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.motion.events.cycles import OFF, STRIKE, GaitCycle, GaitEvent, gait_cycles
from marey.motion.events.feet import FootPath, WalkPaths, ground_velocity

QUANTITIES: Mapping[str, str] = {
    "speed": "m/s", "cadence": "steps/min", "stride_time": "s", "stride_length": "m", "step_time": "s",
    "step_length": "m", "step_width": "m", "stance_time": "s", "swing_time": "s", "stance_share": "%",
    "single_support": "s", "double_support": "s", "foot_progression": "deg", "toe_clearance": "m",
}  # fmt: skip
"""Quantities of a cycle and their units."""
_SETTLED_S = 0.04
"""Time from the strike after which the heel stands still [s]: the impact lasts about 30 ms."""
_FLAT = (0.15, 0.30)
"""Part of the cycle, as ratios to its duration, in which the whole foot stands: heels rise at 0.4 of the cycle of a
walk and at 0.3 in fast walking."""
_MIDDLE_OF_SWING = (0.30, 0.85)
"""Part of the swing in which the toe passes lowest over the floor: its height has a maximum at 0.3 and rises again
before the strike. In the rendered walks it passes at 0.65."""
_MOST_RISE_M = 0.05
"""Largest difference in height between two stances of a foot on a level floor [m]: beyond it, as on stairs and steep
ramps, the floor beneath the swinging toe is not known. Chosen by hand: a step of stairs is 0.1 m or more."""
_SHORTEST_STRIDE_M = 0.1
"""Shortest stride that has a direction [m]; shorter ones are steps in place. Chosen by hand."""


class ParameterValue(NamedTuple):
    """A value with its standard deviation."""

    value: float
    """In the unit of the quantity; NaN if it cannot be measured in this cycle."""
    sd: float = float("nan")
    """Standard deviation from events and paths of points; NaN if unknown."""


NOT_MEASURED = ParameterValue(float("nan"))
"""The value of a quantity whose events or points are missing."""


@dataclass(frozen=True, eq=False, kw_only=True)
class GaitMeasures:
    """The parameters of the C cycles of a walk."""

    cycles: tuple[GaitCycle, ...]
    """The cycles, in the order of their starts."""
    values: Floats
    """(C, K) values of the K `QUANTITIES` in their units; NaN where a quantity cannot be measured."""
    sds: Floats
    """(C, K) standard deviations."""

    def __post_init__(self) -> None:
        freeze_fields(self, "values", "sds")

    def of(self, quantity: str, side: str | None = None) -> tuple[Floats, Floats]:
        """Return the known values (N,) of a quantity and their standard deviations (N,).

        Args:
            quantity: One of `QUANTITIES`.
            side: `left` or `right`; None for the cycles of both feet.
        """
        column = list(QUANTITIES).index(quantity)
        chosen = self.of_side(side) & np.isfinite(self.values[:, column])
        return self.values[chosen, column], self.sds[chosen, column]

    def of_side(self, side: str | None) -> Mask:
        """Return which cycles (C,) are those of a foot; all for None."""
        return np.array([side is None or cycle.side == side for cycle in self.cycles], bool)


def measure_gait(paths: WalkPaths, events: Sequence[GaitEvent]) -> GaitMeasures:
    """Measure every gait cycle.

    A cycle of a foot goes from its strike to its next strike. Lengths are measured between the places where the heels
    stand after the strikes, relative to the ground or the belt beneath them; step length and width along and across the
    line of the stride, as [Huxham2006] recommend for walks that turn. The step of a side ends with the strike of that
    side.

    Args:
        paths: The feet and the body.
        events: Their events.

    Returns:
        The parameters; cycles without a side, or of a foot without a path, have none and are not listed.
    """
    walk = _Walk(paths, events)
    cycles = [cycle for cycle in gait_cycles(events) if cycle.side in walk.feet]
    rows = [_cycle(walk, cycle) for cycle in cycles]
    table = np.array([[row.get(name, NOT_MEASURED) for name in QUANTITIES] for row in rows], float)
    table = table.reshape(len(cycles), len(QUANTITIES), 2)
    return GaitMeasures(cycles=tuple(cycles), values=table[..., 0], sds=table[..., 1])


class _Walk:
    """The feet over the ground, and the events with their standard deviations."""

    def __init__(self, paths: WalkPaths, events: Sequence[GaitEvent]):
        self.time, self.events = paths.time, events
        self.sds = {event.time: event.sd_s for event in events}
        moved = ground_velocity(paths) * (self.time - paths.start_s)[:, None]
        self.feet = {foot.side: _less(foot, moved) for foot in paths.feet if foot.side is not None}

    def first(self, kind: str, side: str, start: float, end: float) -> float:
        """Return the time of the first event of a kind and side within an interval; NaN without one."""
        times = (event.time for event in self.events if (event.kind, event.side) == (kind, side))
        return min((time for time in times if start < time < end), default=float("nan"))

    def spread(self, *times: float) -> float:
        """Return the standard deviation of a difference of event times [s]; NaN if that of one is unknown."""
        each = [self.sds.get(time) for time in times]
        return float(np.sqrt(sum(float("nan") if sd is None else sd**2 for sd in each)))

    def stand(self, side: str, strike: float, duration: float) -> tuple[Floats, float]:
        """Return where a heel stands after a strike (3,) and its standard deviation [m]; NaN if it is not seen."""
        chosen = (self.time >= strike + _SETTLED_S) & (self.time <= strike + _FLAT[1] * duration)
        places = self.feet[side].heel[chosen]
        places = places[np.isfinite(places).all(1)]
        if not len(places):
            return np.full(3, np.nan), float("nan")
        return places.mean(0), float(np.sqrt(places[:, :2].var(0).sum()))


def _less(foot: FootPath, moved: Floats) -> FootPath:
    return FootPath(side=foot.side, heel=foot.heel - moved, toe=None if foot.toe is None else foot.toe - moved)


def _cycle(walk: _Walk, cycle: GaitCycle) -> dict[str, ParameterValue]:
    """Return the quantities of one cycle."""
    assert cycle.side is not None
    duration = cycle.end - cycle.start
    found = {
        "stride_time": ParameterValue(duration, walk.spread(cycle.start, cycle.end)),
        "cadence": ParameterValue(120 / duration, 120 / duration**2 * walk.spread(cycle.start, cycle.end)),
    }
    found |= _supports(walk, cycle)
    found |= _lengths(walk, cycle)
    return found


def _supports(walk: _Walk, cycle: GaitCycle) -> dict[str, ParameterValue]:
    """Return stance, swing, and the times on one foot and on two."""
    start, end, off = cycle.start, cycle.end, cycle.off
    assert cycle.side is not None
    if off is None:
        return {}
    duration = end - start
    stance = ParameterValue(off - start, walk.spread(start, off))
    found = {
        "stance_time": stance, "swing_time": ParameterValue(end - off, walk.spread(off, end)),
        "stance_share": ParameterValue(100 * stance.value / duration, 100 * stance.sd / duration),
    }  # fmt: skip
    other = _other(cycle.side)
    strike = walk.first(STRIKE, other, start, end)
    lift = walk.first(OFF, other, start, end)
    if strike > off:  # a flight: only one foot is ever on the floor
        found["single_support"] = stance
        found["double_support"] = ParameterValue(0.0, 0.0)
    elif lift < strike < off:
        single = ParameterValue(strike - lift, walk.spread(lift, strike))
        found["single_support"] = single
        found["double_support"] = ParameterValue(stance.value - single.value, float(np.hypot(stance.sd, single.sd)))
    return found


def _lengths(walk: _Walk, cycle: GaitCycle) -> dict[str, ParameterValue]:
    """Return stride, step, speed, direction of the foot and clearance of the toe."""
    assert cycle.side is not None
    duration = cycle.end - cycle.start
    begun, begun_sd = walk.stand(cycle.side, cycle.start, duration)
    ended, ended_sd = walk.stand(cycle.side, cycle.end, duration)
    way = (ended - begun) * [1.0, 1.0, 0.0]
    length, sd = float(np.linalg.norm(way)), float(np.hypot(begun_sd, ended_sd))
    if not length > _SHORTEST_STRIDE_M:
        return {}
    ahead = way / length
    speed = length / duration
    timing = walk.spread(cycle.start, cycle.end) / duration
    found = {
        "stride_length": ParameterValue(length, sd),
        "speed": ParameterValue(speed, speed * float(np.hypot(sd / length, timing))),
    }
    other = _other(cycle.side)
    strike = walk.first(STRIKE, other, cycle.start, cycle.end)
    if other in walk.feet and np.isfinite(strike):
        left = np.array([-ahead[1], ahead[0], 0.0])
        stood, stood_sd = walk.stand(other, strike, duration)
        found["step_time"] = ParameterValue(cycle.end - strike, walk.spread(strike, cycle.end))
        found["step_length"] = ParameterValue(float((ended - stood) @ ahead), float(np.hypot(ended_sd, stood_sd)))
        found["step_width"] = ParameterValue(
            float((stood - begun) @ left) * (-1.0 if cycle.side == "left" else 1.0),
            float(np.sqrt(stood_sd**2 + 0.5 * sd**2)),
        )
    return found | _toe(walk, cycle, ahead, level=abs(ended[2] - begun[2]) <= _MOST_RISE_M)


def _toe(walk: _Walk, cycle: GaitCycle, ahead: Floats, *, level: bool) -> dict[str, ParameterValue]:
    """Return the direction of the foot in stance, and on a level floor the clearance of the toe in swing."""
    assert cycle.side is not None
    foot = walk.feet[cycle.side]
    if foot.toe is None:
        return {}
    flat = _part(walk.time, cycle.start, cycle.end, _FLAT)
    along = foot.toe[flat] - foot.heel[flat]
    along = along[np.isfinite(along).all(1)]
    found = {}
    if len(along):
        turned = np.degrees(np.arctan2(ahead[0] * along[:, 1] - ahead[1] * along[:, 0], along @ ahead))
        outward = turned if cycle.side == "left" else -turned
        found["foot_progression"] = ParameterValue(float(outward.mean()), float(outward.std()))
    if cycle.off is not None and len(along) and level:
        heights = foot.toe[_part(walk.time, cycle.off, cycle.end, _MIDDLE_OF_SWING), 2]
        stance = foot.toe[flat, 2]
        stance = stance[np.isfinite(stance)]
        if len(heights) > 2 and np.isfinite(heights).all() and 0 < np.argmin(heights) < len(heights) - 1:
            found["toe_clearance"] = ParameterValue(float(heights.min() - np.median(stance)), float(stance.std()))
    return found


def _part(time: Floats, start: float, end: float, part: tuple[float, float]) -> Mask:
    """Return the frames (F,) in a part of an interval."""
    share = (time - start) / (end - start)
    return np.asarray((share >= part[0]) & (share <= part[1]))


def _other(side: str) -> str:
    return "right" if side == "left" else "left"
