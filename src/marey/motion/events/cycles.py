"""Gait events, gait cycles, and curves over the cycle."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from marey.arrays import Floats

STRIKE, OFF = "strike", "off"
"""Kinds of gait event: the foot strikes the floor, or leaves it."""
GIVEN = "given"
"""Source of an event that a file contains."""
_LONGEST_CYCLE_S = 3.0
"""Longest gait cycle [s]; strikes farther apart belong to different walks. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class GaitEvent:
    """An event of a foot: strike or off."""

    kind: str
    """STRIKE or OFF."""
    side: str | None
    """`left`, `right`, or None if unknown."""
    time: float
    """Time on the trial's clock [s]."""
    source: str
    """`given` (in the file), `markers`, `body` (a captured one) or `force`."""
    sd_s: float | None = None
    """Standard deviation of the time [s]; None if unknown, as of an event that a file gives."""


@dataclass(frozen=True, kw_only=True)
class GaitCycle:
    """A gait cycle from one strike of a foot to its next."""

    side: str | None
    """`left`, `right`, or None if unknown."""
    start: float
    """Time of the first strike [s]."""
    end: float
    """Time of the next strike [s]."""
    off: float | None
    """Time at which the foot leaves the floor [s]; None if unknown."""


def gait_cycles(events: Sequence[GaitEvent], *, longest_s: float = _LONGEST_CYCLE_S) -> tuple[GaitCycle, ...]:
    """List the cycles of each foot, in the order of their starts.

    Args:
        events: Events in any order.
        longest_s: Longest gait cycle [s]; strikes farther apart belong to different walks.

    Returns:
        The cycles.
    """
    cycles = []
    for side in {event.side for event in events}:
        strikes = sorted(e.time for e in events if e.side == side and e.kind == STRIKE)
        offs = sorted(e.time for e in events if e.side == side and e.kind == OFF)
        for start, end in pairwise(strikes):
            if 0 < end - start <= longest_s:
                inside = [time for time in offs if start < time < end]
                cycles.append(GaitCycle(side=side, start=start, end=end, off=inside[0] if inside else None))
    return tuple(sorted(cycles, key=lambda cycle: (cycle.start, cycle.side or "")))


def over_cycles(values: Floats, time: Floats, cycles: Sequence[GaitCycle], *, points: int = 101) -> Floats:
    """Resample curves over the gait cycle, 0 to 100 % in equal steps, by linear interpolation.

    Args:
        values: (F, ...) one sample per frame; NaN where unknown.
        time: (F,) increasing times [s].
        cycles: C cycles.
        points: Number P of points of each curve.

    Returns:
        (C, P, ...); NaN where one of the two adjacent frames is unknown, and outside of the trial.
    """
    values, time = np.asarray(values, float), np.asarray(time, float)
    share = np.linspace(0, 1, points)
    at = np.array([c.start + share * (c.end - c.start) for c in cycles]).reshape(len(cycles), points)
    if len(time) < 2:
        return np.full((*at.shape, *values.shape[1:]), np.nan)
    slack = 1e-6 * (time[1] - time[0])  # events and frames are rounded independently
    at = np.where((at >= time[0] - slack) & (at <= time[-1] + slack), np.clip(at, time[0], time[-1]), np.nan)
    before = np.clip(np.searchsorted(time, np.nan_to_num(at), side="right") - 1, 0, len(time) - 2)
    part = (at - time[before]) / (time[before + 1] - time[before])
    part = part.reshape(*at.shape, *[1] * (values.ndim - 1))
    first, second = values[before], values[before + 1]
    # A point that coincides with a frame needs only that frame.
    return np.asarray(np.where(part == 0, first, np.where(part == 1, second, first * (1 - part) + second * part)))
