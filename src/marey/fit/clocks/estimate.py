"""Estimation of the clocks of all cameras from their signals, with the reasons where it fails."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.cameras.clocks import Clocks
from marey.fit.clocks.clock_fit import fit_clocks
from marey.fit.clocks.comparison import SampledSignal
from marey.fit.clocks.lags import LagSearch, pair_costs
from marey.fit.clocks.signals import EpipolarSignal

LONGEST_LAG_S = 10.0
"""Largest offset of two cameras that is searched for [s]. Chosen by hand."""
LONGEST_SHARE = 0.5
"""The same as a share of the shortest video: the rest is what both cameras show. Chosen by hand."""
STEPS_PER_FRAME = 2
"""Lags that are compared per frame of the slowest camera. Chosen by hand."""
RIVAL_FRAMES = 4
"""Lags that differ by fewer frames belong to one minimum. Chosen by hand."""
LARGEST_SD_FRAMES = 0.5
"""Standard deviation of an offset above which it is not determined [frames]: cameras that were started together would
agree better. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class ClockEstimate:
    """Estimated clocks, of those cameras whose clocks the signals determine."""

    clocks: Clocks
    """The clocks of the determined cameras; the first camera is always among them."""
    undetermined: dict[str, str]
    """Reasons why the clocks of the other cameras are not determined, by camera."""
    residual_px: float
    """Root mean square of the weighted differences of the signals [px]; NaN without any signal."""
    signals: int
    """Number of signals."""


def estimate_clocks(
    names: Sequence[str], times: Sequence[Floats], signals: Sequence[EpipolarSignal]
) -> ClockEstimate:
    """Estimate offset and drift of each camera's clock relative to the first camera's.

    Args:
        names: C cameras.
        times: (F,) times of each camera's pictures in its own video [s].
        signals: Signals that pairs of cameras share.

    Returns:
        The clocks, and the cameras whose clocks cannot be determined.
    """
    sampled = [SampledSignal.of(signal, times) for signal in signals if _is_used(signal)]
    frame = max(float(np.median(np.diff(own))) for own in times)
    step = frame / STEPS_PER_FRAME
    shortest = min(float(own[-1] - own[0]) for own in times)
    reach = int(min(LONGEST_LAG_S, LONGEST_SHARE * shortest) / step)
    search = LagSearch(pair_costs(sampled, step, reach), len(names), reach)
    lags = search.best()
    fit = fit_clocks(sampled, lags * step)
    offset_sd, drift_sd = fit.spread
    reasons: dict[str, str] = {}
    for c, name in enumerate(names[1:], 1):
        rival = search.rival(c, lags, apart=RIVAL_FRAMES * STEPS_PER_FRAME)
        if not any(c in signal.cameras for signal in sampled):
            reasons[name] = "it shares no moving point with another camera"
        elif offset_sd[c] > LARGEST_SD_FRAMES * frame:
            reasons[name] = f"nothing moves enough: its offset is uncertain by {1000 * offset_sd[c]:.0f} ms"
        elif rival is not None:
            reasons[name] = f"offsets of {lags[c] * step:.2f} and {rival * step:.2f} s fit about equally well"
    kept = [c for c, name in enumerate(names) if name not in reasons]
    clocks = Clocks(
        names=tuple(names[c] for c in kept), offset_s=fit.offset_s[kept], drift=fit.drift[kept],
        offset_sd_s=offset_sd[kept], drift_sd=drift_sd[kept],
    )  # fmt: skip
    return ClockEstimate(clocks, reasons, fit.residual_px, len(sampled))


def _is_used(signal: EpipolarSignal) -> bool:
    return all(np.count_nonzero(np.isfinite(angles)) for angles in signal.angles)
