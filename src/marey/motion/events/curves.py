"""Mean curves over the gait cycle, and where the feet strike and leave the floor in it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.motion.events.cycles import STRIKE, GaitCycle, GaitEvent, over_cycles
from marey.motion.events.summaries import LEAST_CYCLES

CYCLE_POINTS = 101
"""Number of points of a curve, one per percent of the cycle."""
_UNIT_ENDINGS = ("_deg", "_mm")
"""Endings of the names of quantities: their units."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CycleCurves:
    """Quantities over 0 to 100 % of the gait cycle."""

    names: tuple[str, ...]
    """N names, with units as in the tables."""
    mean: Floats
    """(101, N) mean over the cycles."""
    spread: Floats
    """(101, N) standard deviation between the cycles; NaN for fewer than three cycles."""
    counts: tuple[int, ...]
    """(N,) number of cycles."""
    sides: tuple[str | None, ...]
    """(N,) side of the cycles of each quantity; None if it is unknown."""


@dataclass(frozen=True, kw_only=True)
class CycleMark:
    """An event in the mean cycle of a foot."""

    side: str | None
    """Side of the cycle."""
    percent: float
    """Place in the cycle, from 0 to 100."""
    own: bool
    """True for the off of the foot itself, False for the strike of the other one."""


def average_over_cycles(
    names: Sequence[str], values: Floats, time: Floats, cycles: Sequence[GaitCycle], *, side: str | None = None
) -> CycleCurves | None:  # fmt: skip
    """Average quantities over the gait cycles of their own side.

    Args:
        names: N names; `left_...`, or `..._l` as in OpenSim's models, before a unit `_deg` or `_mm`.
        values: (F, N).
        time: (F,) [s].
        cycles: Cycles of both feet.
        side: `left` or `right`, for quantities whose names do not contain it.

    Returns:
        None if no cycle has values in all of its frames.
    """
    mean, spread, counts, sides = [], [], [], []
    for k, name in enumerate(names):
        own = cycles_of_side(cycles, side_of(name) or side)
        curves = over_cycles(values[:, k], time, own, points=CYCLE_POINTS)
        whole = curves[np.isfinite(curves).all(1)]
        counts.append(len(whole))
        sides.append(own[0].side if own else None)
        mean.append(whole.mean(0) if len(whole) else np.full(CYCLE_POINTS, np.nan))
        spread.append(whole.std(0, ddof=1) if len(whole) >= LEAST_CYCLES else np.full(CYCLE_POINTS, np.nan))
    if not any(counts):
        return None
    return CycleCurves(
        names=tuple(names), mean=np.stack(mean, 1), spread=np.stack(spread, 1), counts=tuple(counts), sides=tuple(sides)
    )


def side_of(name: str) -> str | None:
    """Return the side of a quantity: `left_knee_flexion`, or `knee_angle_l` as in OpenSim's models."""
    if name.startswith(("left_", "right_")):
        return name.partition("_")[0]
    bare = name
    for ending in _UNIT_ENDINGS:
        bare = bare.removesuffix(ending)
    return {"_l": "left", "_r": "right"}.get(bare[-2:])


def without_side(name: str) -> str:
    """Return the name of a quantity without its side, for example `knee_flexion_deg` for that of the left knee."""
    side = side_of(name)
    if side is None or name.startswith(f"{side}_"):
        return name if side is None else name.removeprefix(f"{side}_")
    unit = next((ending for ending in _UNIT_ENDINGS if name.endswith(ending)), "")
    return name.removesuffix(unit)[:-2] + unit


def cycles_of_side(cycles: Sequence[GaitCycle], side: str | None) -> list[GaitCycle]:
    """Return the cycles of a side; a quantity without a side uses those of the right foot, or else the others."""
    sides = {cycle.side for cycle in cycles}
    for wanted in (side, None, *(() if side else ("right", "left"))):
        if wanted in sides:
            return [cycle for cycle in cycles if cycle.side == wanted]
    return []


def cycle_marks(cycles: Sequence[GaitCycle], events: Sequence[GaitEvent]) -> tuple[CycleMark, ...]:
    """Return where, in the mean cycle of each side, the foot leaves the floor and the other one strikes.

    Args:
        cycles: Cycles of both feet.
        events: Their events.
    """
    marks = []
    for side in sorted({cycle.side for cycle in cycles}, key=str):
        own = [cycle for cycle in cycles if cycle.side == side]
        offs = [_percent(cycle, cycle.off) for cycle in own if cycle.off is not None]
        others = [
            _percent(cycle, event.time) for cycle in own for event in events
            if event.kind == STRIKE and None not in (event.side, side) and event.side != side
            and cycle.start < event.time < cycle.end
        ]  # fmt: skip
        for found, is_own in ((offs, True), (others, False)):
            if found:
                marks.append(CycleMark(side=side, percent=float(np.mean(found)), own=is_own))
    return tuple(marks)


def _percent(cycle: GaitCycle, time: float) -> float:
    return 100 * (time - cycle.start) / (cycle.end - cycle.start)
