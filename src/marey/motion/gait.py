"""Gait: events of the feet, cycles between them, and curves over the cycle."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from marey.arrays import Floats

STRIKE, OFF = "strike", "off"
_LONGEST_S = 3.0  # of a gait cycle


@dataclass(frozen=True, kw_only=True)
class GaitEvent:
    """A foot meets or leaves the floor."""

    kind: str
    """STRIKE or OFF."""
    side: str | None
    """`left`, `right`, or None where it is not known."""
    time: float
    """On the trial's clock [s]."""
    source: str
    """`given` in the file, found from `markers`, or from `force`."""


@dataclass(frozen=True, kw_only=True)
class GaitCycle:
    """From one strike of a foot to its next."""

    side: str | None
    start: float
    """[s]."""
    end: float
    """[s]."""
    off: float | None
    """When the foot left the floor [s]; None where that is not known."""


def gait_cycles(events: Sequence[GaitEvent], *, longest_s: float = _LONGEST_S) -> tuple[GaitCycle, ...]:
    """List the cycles of each foot, in the order of their beginnings.

    Args:
        events: In any order.
        longest_s: Two strikes farther apart belong to different walks [s].
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
    """Put curves over the cycle: 0 to 100 % in even steps, linear between the frames.

    Args:
        values: (F, ...) one sample a frame; NaN where unknown.
        time: (F,) [s], rising.
        cycles: C of them.
        points: P, of each curve.

    Returns:
        (C, P, ...); NaN where one of the two frames around a point is unknown, or the trial does not reach.
    """
    values, time = np.asarray(values, float), np.asarray(time, float)
    share = np.linspace(0, 1, points)
    at = np.array([c.start + share * (c.end - c.start) for c in cycles]).reshape(len(cycles), points)
    if len(time) < 2:
        return np.full((*at.shape, *values.shape[1:]), np.nan)
    slack = 1e-6 * (time[1] - time[0])  # events and frames are rounded apart
    at = np.where((at >= time[0] - slack) & (at <= time[-1] + slack), np.clip(at, time[0], time[-1]), np.nan)
    before = np.clip(np.searchsorted(time, np.nan_to_num(at), side="right") - 1, 0, len(time) - 2)
    part = (at - time[before]) / (time[before + 1] - time[before])
    part = part.reshape(*at.shape, *[1] * (values.ndim - 1))
    first, second = values[before], values[before + 1]
    # A point that falls on a frame needs only that frame.
    return np.where(part == 0, first, np.where(part == 1, second, first * (1 - part) + second * part))
