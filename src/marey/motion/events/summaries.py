"""Means of spatio-temporal parameters over the cycles of a walk, with intervals, and differences between the sides."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from marey.arrays import Floats
from marey.motion.events.parameters import QUANTITIES, GaitMeasures

LEAST_CYCLES = 3
"""Number of cycles from which on their standard deviation is stated: that of two is itself uncertain by 71 %, that of
three by 50 %."""
_LEVEL = 0.95
"""Probability of the intervals."""
_ONE_SIDED = ("cadence", "speed", "step_width")
"""Quantities whose difference between the sides has no meaning: both feet share them."""
_IN_UNITS = ("foot_progression", "toe_clearance")
"""Quantities that may be zero: their difference between the sides is stated in their unit, not in percent."""
ASYMMETRY = "_asymmetry"
"""Ending of the name of a difference between the sides, left minus right."""


@dataclass(frozen=True, kw_only=True)
class GaitSummary:
    """One quantity of one side, over its cycles."""

    quantity: str
    """One of `QUANTITIES`, or that with the ending `_asymmetry`."""
    side: str
    """`left`, `right` or `both`."""
    unit: str
    """Unit of value, standard deviation and interval."""
    value: float
    """Mean over the cycles."""
    sd: float
    """Standard deviation between the cycles; NaN for fewer than three."""
    low: float
    """Lower end of the 95 % interval of the mean; NaN if unknown."""
    high: float
    """Upper end of the 95 % interval of the mean; NaN if unknown."""
    cycles: int
    """Number of cycles."""


def summarise_gait(measures: GaitMeasures) -> tuple[GaitSummary, ...]:
    """Average every quantity over the cycles of each side and of both, and compare the sides.

    The interval of a mean combines the variation between cycles (Student's t, from three cycles on) with the standard
    deviations of events and points, which are taken as common to all cycles: most of the error of an event is that of
    the method with this person and not that of a single step.

    Args:
        measures: The parameters of the cycles.

    Returns:
        One entry per quantity and side with at least one cycle, in the order of `QUANTITIES`.
    """
    found: list[GaitSummary] = []
    for quantity, unit in QUANTITIES.items():
        sides = {side: _mean(measures, quantity, side) for side in ("left", "right", "both")}
        found += [entry for entry in sides.values() if entry is not None]
        left, right = sides["left"], sides["right"]
        if left is not None and right is not None and quantity not in _ONE_SIDED:
            found += _difference(left, right, unit)
    return tuple(found)


def _mean(measures: GaitMeasures, quantity: str, side: str) -> GaitSummary | None:
    values, sds = measures.of(quantity, None if side == "both" else side)
    if not len(values):
        return None
    half, mean = half_width_of_mean(values, sds), float(values.mean())
    sd = float(values.std(ddof=1)) if len(values) >= LEAST_CYCLES else float("nan")
    return GaitSummary(
        quantity=quantity, side=side, unit=QUANTITIES[quantity], value=mean, sd=sd, low=mean - half, high=mean + half,
        cycles=len(values),
    )  # fmt: skip


def half_width_of_mean(values: Floats, sds: Floats) -> float:
    """Return half of the 95 % interval of a mean, as for `summarise_gait`.

    Args:
        values: (N,) the values of the cycles or repetitions.
        sds: (N,) their standard deviations, taken as common to all; NaN where unknown.

    Returns:
        NaN if neither the values nor their standard deviations state an uncertainty.
    """
    normal = float(ndtri(0.5 + _LEVEL / 2))
    known = sds[np.isfinite(sds)]
    common = normal * float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
    if len(values) < LEAST_CYCLES:
        return common
    between = stdtrit(len(values) - 1, 0.5 + _LEVEL / 2) * values.std(ddof=1) / np.sqrt(len(values))
    return float(np.hypot(between, common)) if len(known) else float(between)


def _difference(left: GaitSummary, right: GaitSummary, unit: str) -> Iterator[GaitSummary]:
    """Yield the difference between the sides, in percent of their mean or in the unit of a quantity near zero."""
    mean = 0.5 * (left.value + right.value)
    relative = left.quantity not in _IN_UNITS
    if relative and not mean > 0:
        return
    scale = 100 / mean if relative else 1.0
    value = scale * (left.value - right.value)
    half = scale * float(np.hypot(left.high - left.value, right.high - right.value))
    yield GaitSummary(
        quantity=left.quantity + ASYMMETRY, side="both", unit="%" if relative else unit, value=value, sd=float("nan"),
        low=value - half, high=value + half, cycles=min(left.cycles, right.cycles),
    )  # fmt: skip
