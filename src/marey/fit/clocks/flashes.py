"""Offsets of cameras from light that they all show: a flash, or a lamp that is switched on or off."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.cameras.clocks import Clocks
from marey.fit.clocks.clock_fit import DRIFT_SD
from marey.fit.clocks.estimate import LONGEST_LAG_S, ClockEstimate

LEAST_JUMP = 0.06
"""Least sudden change of the brightness of most of an image, relative to the usual one. The largest change from one
picture to the next in nine takes of `data/people` was 0.017, in `market`, whose light flickers by 4 %, and 0.008 in
the others."""
JUMP_DEVIATIONS = 8.0
"""The same in standard deviations of all changes, estimated from their median: in flickering light, nothing is a jump.
The changes of a sine or an alternation are at most 1.6 of these deviations. Chosen by hand."""
LONGEST_FLASH = 3
"""Largest number of pictures that a flash brightens; longer light is a lamp. Chosen by hand."""
MATCH_FRAMES = 1.5
"""Largest difference of the instants of one event in two cameras, in the longer one of both frame periods: each of them
is known to half a frame, and rolling shutters add some of the readout time."""
LEAST_MATCHED = 0.5
"""Least share of the events that both cameras should show which agree. Chosen by hand."""
_MEDIAN_TO_DEVIATION = 1.4826
"""Ratio of a normal distribution's standard deviation to its median absolute deviation."""


@dataclass(frozen=True)
class LightEvent:
    """A sudden change of the light."""

    kind: str
    """"flash", "on" or "off"."""
    time_s: float
    """Instant in the camera's video [s]."""
    sd_s: float
    """Standard deviation of the instant [s]: that of a uniform distribution over the time between two pictures."""


def light_events(changes: Floats, times: Floats) -> list[LightEvent]:
    """Find flashes, and lamps that are switched on or off.

    A picture shows the light of about one frame period before and after which nothing is known, so that the instants
    are no better than that.

    Args:
        changes: (F,) relative change of the brightness from the picture before, see `brightness_changes`.
        times: (F,) of the pictures [s].

    Returns:
        The events, in order.
    """
    if len(changes) < 3:
        return []
    period = float(np.median(np.diff(times)))
    spread = _MEDIAN_TO_DEVIATION * float(np.median(np.abs(changes - np.median(changes))))
    limit, sd = max(LEAST_JUMP, JUMP_DEVIATIONS * spread), period / np.sqrt(12)
    found: list[LightEvent] = []
    jumps = _jumps(changes, limit)
    k = 0
    while k < len(jumps):
        first, last = jumps[k]
        ended = k + 1 < len(jumps) and jumps[k + 1][0] - first <= LONGEST_FLASH
        if changes[first] > 0 and ended and changes[jumps[k + 1][0]] < 0:
            lit = np.arange(first, jumps[k + 1][1] + 1)
            excess = np.maximum(np.cumsum(changes[lit]), 0.0)
            found.append(LightEvent("flash", float(excess @ times[lit] / excess.sum()), float(sd)))
            k += 2
            continue
        step = np.arange(first, last + 1)
        # Of light that is switched on between two pictures, the second one is the first to show it.
        at = float(changes[step] @ times[step] / changes[step].sum()) - 0.5 * period
        found.append(LightEvent("on" if changes[first] > 0 else "off", at, float(sd)))
        k += 1
    return found


def _jumps(changes: Floats, limit: float) -> list[tuple[int, int]]:
    """Return the first and last pictures of the runs of changes of one sign that exceed a limit."""
    runs: list[tuple[int, int]] = []
    for f in np.flatnonzero(np.abs(changes) > limit).tolist():
        if runs and f == runs[-1][1] + 1 and changes[f] * changes[f - 1] > 0:
            runs[-1] = runs[-1][0], f
        else:
            runs.append((f, f))
    return runs


def flash_clocks(
    names: Sequence[str], events: Sequence[Sequence[LightEvent]], times: Sequence[Floats]
) -> ClockEstimate:
    """Estimate the clock of each camera from the changes of light that it and the first camera show.

    Args:
        names: C cameras.
        events: The events of each camera.
        times: (F,) times of each camera's pictures in its own video [s].

    Returns:
        The clocks of the cameras that show the same events; the drift is measured if there are several.
    """
    rows, reasons = {names[0]: (0.0, 0.0, 0.0, 0.0)}, {}
    for c, name in enumerate(names[1:], 1):
        pairs = _matched(events[0], events[c], (times[0], times[c]))
        if pairs is None:
            seen = events[0] and events[c]
            reasons[name] = "no flash is clearly that of the first camera" if seen else "it shows no flash"
        else:
            rows[name] = _fitted(pairs)
    offset_s, offset_sd_s, drift, drift_sd = np.array(list(rows.values())).T
    clocks = Clocks(names=tuple(rows), offset_s=offset_s, drift=drift, offset_sd_s=offset_sd_s, drift_sd=drift_sd)
    return ClockEstimate(clocks, reasons, float("nan"), sum(map(len, events)))


_Pairs = list[tuple[LightEvent, LightEvent]]
"""The same events in two cameras."""


def _matched(
    first: Sequence[LightEvent], other: Sequence[LightEvent], times: tuple[Floats, Floats]
) -> _Pairs | None:
    """Return the events that two cameras have in common at the offset with most of them; None if it is not unique."""
    apart = MATCH_FRAMES * max(float(np.median(np.diff(own))) for own in times if len(own) > 1)
    tried = {
        one.time_s - two.time_s
        for one in first for two in other
        if one.kind == two.kind and abs(one.time_s - two.time_s) <= LONGEST_LAG_S
    }  # fmt: skip
    found = [(_pairs(first, other, offset, apart), offset) for offset in sorted(tried)]
    if not found:
        return None
    best, offset = max(found, key=lambda each: (len(each[0]), -_scatter(each[0])))
    rivals = [len(pairs) for pairs, own in found if abs(own - offset) > 2 * apart]
    expected = min(
        sum(times[1][0] <= one.time_s - offset <= times[1][-1] for one in first),
        sum(times[0][0] <= two.time_s + offset <= times[0][-1] for two in other),
    )
    clear = len(best) > max(rivals, default=0) and len(best) >= LEAST_MATCHED * expected
    return best if clear else None


def _pairs(first: Sequence[LightEvent], other: Sequence[LightEvent], offset: float, apart: float) -> _Pairs:
    """Return the pairs of events of one kind that are at equal instants for an offset of the second camera."""
    pairs = []
    for one in first:
        same = [two for two in other if two.kind == one.kind and abs(two.time_s + offset - one.time_s) <= apart]
        if same:
            pairs.append((one, min(same, key=lambda two: abs(two.time_s + offset - one.time_s))))
    return pairs


def _scatter(pairs: _Pairs) -> float:
    late = [one.time_s - two.time_s for one, two in pairs]
    return float(np.ptp(late)) if late else 0.0


def _fitted(pairs: _Pairs) -> tuple[float, float, float, float]:
    """Return offset, its standard deviation, drift and its own, by least squares with the prior of a drift."""
    late = np.array([one.time_s - two.time_s for one, two in pairs])
    sd = np.array([np.hypot(one.sd_s, two.sd_s) for one, two in pairs])
    rows = np.stack([np.ones(len(pairs)), [two.time_s for _, two in pairs]], axis=1) / sd[:, None]
    covariance = np.linalg.inv(rows.T @ rows + np.diag([0.0, DRIFT_SD**-2]))
    offset, drift = covariance @ rows.T @ (late / sd)
    spread = np.sqrt(np.diag(covariance))
    return float(offset), float(spread[0]), float(drift), float(spread[1])
