"""Offsets of cameras from the sound that they recorded: the lag at which the onsets of two recordings agree.

A clap, a door or a voice begins at once. The onsets, not the waves, are compared, because two microphones at different
places record different waves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.cameras.clocks import Clocks
from marey.fit.clocks.clock_fit import DRIFT_SD
from marey.fit.clocks.estimate import LONGEST_LAG_S, ClockEstimate

HOP_S = 0.002
"""Time between two values of the strength of onsets [s]. Chosen by hand."""
WINDOW_HOPS = 3
"""Number of hops over which the energy of the sound is averaged. Chosen by hand."""
FLOOR = 1e-4
"""Amplitude below which sound counts as silence, relative to full scale. Chosen by hand."""
STRONGEST = 4.0
"""Largest strength of an onset, in units of the logarithm of the amplitude, so that one clap does not decide alone.
Chosen by hand."""
LEAST_CORRELATION = 0.5
"""Least correlation of the onsets of two recordings at the best lag. Made recordings of 10 s that have nothing in
common reach 0.08 with noise alone, and 0.42 with four claps at other instants in each (30 pairs)."""
CLEAR_RATIO = 1.25
"""Least ratio of the correlation at the best lag to that at any other one, which repeated sounds do not reach. Chosen
by hand."""
APART_S = 0.1
"""Lags that differ by less belong to one maximum [s]. Chosen by hand."""
LEAST_COMMON_S = 2.0
"""Least time that both recordings have in common at a lag [s]. Chosen by hand."""
SOUND_SD_S = 0.006
"""Standard deviation of an offset from sound [s]: sound takes 6 ms for 2 m, by which the distances of a source from two
cameras differ easily, and cameras delay sound relative to pictures by some milliseconds. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeardOnsets:
    """The strength of the onsets in the recording of one camera."""

    strength: Floats
    """(n,) every `HOP_S`, with mean zero."""
    begin_s: float
    """Time of the first value in the camera's video [s]."""


def onsets(samples: Floats, rate: float, begin_s: float) -> HeardOnsets:
    """Measure the strength of onsets: the rises of the logarithm of the energy.

    Args:
        samples: (n,) sound, from -1 to 1.
        rate: Samples per second [Hz].
        begin_s: Time of the first sample in the camera's video [s].

    Returns:
        The strengths.
    """
    hop = round(HOP_S * rate)
    count = len(samples) // hop
    energy = np.square(np.asarray(samples[: count * hop], float)).reshape(count, hop).mean(axis=1)
    smooth = np.convolve(energy, np.full(WINDOW_HOPS, 1 / WINDOW_HOPS), mode="same")
    level = 0.5 * np.log(smooth + FLOOR**2)
    before = np.concatenate([np.repeat(level[:1], WINDOW_HOPS), level[:-WINDOW_HOPS]]) if count > WINDOW_HOPS else level
    strength = np.clip(level - before, 0.0, STRONGEST)
    return HeardOnsets(strength=strength - strength.mean() if count else strength, begin_s=begin_s)


def sound_clocks(names: Sequence[str], heard: Sequence[HeardOnsets | None]) -> ClockEstimate:
    """Estimate the offset of each camera's clock from the sounds that it and the first camera recorded.

    Args:
        names: C cameras.
        heard: The onsets of each camera; None for a camera without sound.

    Returns:
        The clocks of the cameras that recorded the same sounds; their drifts are not measured.
    """
    reasons: dict[str, str] = {}
    offsets = {names[0]: 0.0}
    for name, own in zip(names[1:], heard[1:], strict=True):
        found = None if own is None or heard[0] is None else _offset(heard[0], own)
        if found is None:
            silent = own is None or heard[0] is None
            reasons[name] = "it recorded no sound" if silent else "no sound is clearly that of the first camera"
        else:
            offsets[name] = found
    kept, count = tuple(offsets), len(offsets)
    later = np.arange(count) > 0
    clocks = Clocks(
        names=kept, offset_s=np.array(list(offsets.values())), drift=np.zeros(count), offset_sd_s=SOUND_SD_S * later,
        drift_sd=DRIFT_SD * later,
    )  # fmt: skip
    return ClockEstimate(clocks, reasons, float("nan"), sum(each is not None for each in heard))


def _offset(first: HeardOnsets, own: HeardOnsets) -> float | None:
    """Return the offset of a camera [s]; None if the recordings do not show it clearly."""
    one, other = first.strength, own.strength
    norm = float(np.linalg.norm(one) * np.linalg.norm(other))
    if not norm > 0:
        return None
    # Imported where it is needed: it takes a quarter of the time of the start of a program.
    from scipy.signal import correlate

    values = correlate(one, other, mode="full", method="fft") / norm
    lags = np.arange(1 - len(other), len(one))
    common = np.minimum(len(one), lags + len(other)) - np.maximum(lags, 0)
    allowed = (common * HOP_S >= LEAST_COMMON_S) & (np.abs(lags) * HOP_S <= LONGEST_LAG_S)
    if not allowed.any():
        return None
    values = np.where(allowed, values, -np.inf)
    best = int(np.argmax(values))
    far = np.abs(lags - lags[best]) * HOP_S > APART_S
    rival = values[far].max(initial=0.0)
    if values[best] < LEAST_CORRELATION or values[best] < CLEAR_RATIO * rival:
        return None
    return float((lags[best] + _summit(values, best)) * HOP_S + first.begin_s - own.begin_s)


def _summit(values: Floats, best: int) -> float:
    """Return the place of a maximum between samples, from a parabola through it and its neighbours [samples]."""
    near = values[max(best - 1, 0) : best + 2]
    if len(near) < 3 or not np.isfinite(near).all():
        return 0.0
    bend = near[0] - 2 * near[1] + near[2]
    return float(0.5 * (near[0] - near[2]) / bend) if bend < 0 else 0.0


def combined(estimates: Sequence[ClockEstimate], names: Sequence[str]) -> ClockEstimate:
    """Combine estimates of the same clocks from different sources, each weighted by its precision.

    Args:
        estimates: The estimates; their errors are independent.
        names: C cameras, the first of which defines the clock.

    Returns:
        The clocks of all cameras that one of the sources determines.
    """
    rows, reasons = {names[0]: (0.0, 0.0, 0.0, 0.0)}, {}
    for name in names[1:]:
        own = [(each.clocks, each.clocks.names.index(name)) for each in estimates if name in each.clocks.names]
        if own:
            offset = _weighted([(c.offset_s[k], c.offset_sd_s[k]) for c, k in own])
            rows[name] = (*offset, *_weighted([(c.drift[k], c.drift_sd[k]) for c, k in own], prior_sd=DRIFT_SD))
        else:
            reasons[name] = "; ".join(dict.fromkeys(each.undetermined[name] for each in estimates))
    offset_s, offset_sd_s, drift, drift_sd = np.array(list(rows.values())).T
    clocks = Clocks(names=tuple(rows), offset_s=offset_s, drift=drift, offset_sd_s=offset_sd_s, drift_sd=drift_sd)
    residual = next((each.residual_px for each in estimates if np.isfinite(each.residual_px)), float("nan"))
    return ClockEstimate(clocks, reasons, residual, sum(each.signals for each in estimates))


def _weighted(values: Sequence[tuple[float, float]], *, prior_sd: float = np.inf) -> tuple[float, float]:
    """Return the weighted mean of values with standard deviations, and its own.

    Each of the values contains the same prior about 0, which counts once.
    """
    value, sd = np.array(values, float).T
    weight = 1 / np.maximum(sd, 1e-12) ** 2
    total = max(float(weight.sum()) - (len(values) - 1) / prior_sd**2, float(weight.max()))
    return float(weight @ value / total), float(1 / np.sqrt(total))
