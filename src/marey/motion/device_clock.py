"""The clock of a foreign device against the cameras': offset and rate from signals or events, and resampling."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from marey.arrays import Floats, freeze_fields
from marey.errors import MareyError
from marey.motion.alignment import REPEATED_SD_S, long_run_variance
from marey.motion.filters import MINIMUM_RATE_RATIO, low_pass
from marey.motion.recording import interpolated
from marey.motion.shift_search import agreement_by_lag


class ClockUndetermined(MareyError):
    """Signals or events that do not determine a device's clock.

    Args:
        why: The reason, as a clause.
    """

    def __init__(self, why: str):
        super().__init__(f"No clock can be estimated: {why}")


@dataclass(frozen=True, kw_only=True)
class DeviceClockSettings:
    """Settings of the estimation of a device's clock; chosen by hand."""

    largest_drift: float = 0.015
    """Largest difference of the rates that is searched [s/s]."""
    drift_sd: float = np.inf
    """Standard deviation of the drift before it is measured [s/s]; infinite if nothing is known of the rates."""
    offsets: tuple[float, float] = (-np.inf, np.inf)
    """Least and largest time of the device at the cameras' instant 0 that is searched [s]."""
    smooth_hz: float = 10.0
    """Cut-off of the low-pass filter of both signals [Hz]."""
    samples_per_cycle: float = 6.0
    """Samples that are kept of a faster signal per period of the cut-off."""
    search_hz: float = 30.0
    """Rate of the grid on which the offset is searched [Hz]."""
    drift_step_s: float = 0.1
    """Step of the drift's grid, as the shift that it makes over the whole recording [s]."""
    least_overlap: float = 0.5
    """Smallest overlap as a share of the shorter signal."""
    rival_ratio: float = 1.3
    """No answer if another offset leaves at most this multiple of the best one's remaining variance."""
    rival_apart_s: float = 0.15
    """Smallest difference between the best offset and another one [s]."""
    least_left: float = 0.01
    """Share of the variance left unexplained below which two offsets fit equally well."""
    largest_left: float = 0.5
    """Largest share of the variance that an accepted clock leaves unexplained."""
    chance: float = 0.01
    """Largest probability that unrelated signals agree as well at one of the offsets that are searched."""
    least_frames: int = 20
    """Fewest common frames."""
    most_steps: int = 20
    """Most Gauss-Newton steps."""
    correlated_s: float = 0.5
    """Time over which residuals may be correlated [s]: about a step."""
    repeated_sd_s: float = REPEATED_SD_S
    """Standard deviation of the offset by errors that repeat with each step [s]."""
    match_s: float = 0.05
    """Largest difference of matched events [s]."""
    least_events: int = 4
    """Fewest matched events."""
    event_rival: float = 0.8
    """No answer if another offset matches at least this share of the best one's events."""


DEVICE_CLOCK_DEFAULTS = DeviceClockSettings()
"""Default settings of the estimation of a device's clock."""


@dataclass(frozen=True, kw_only=True)
class SignalGroup:
    """Signals of the motion and of a device that are linear in each other, such as the axes of a gyroscope."""

    own: tuple[int, ...]
    """Columns of the motion's signals."""
    device: tuple[int, ...]
    """Columns of the device's signals."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviceClock:
    """Offset and drift of a device's clock: its time t is the cameras' instant t + offset + drift t."""

    offset_s: float
    """The cameras' instant at the device's time 0 [s]."""
    drift: float
    """Gain of the cameras' instants over the device's time [s/s]."""
    covariance: Floats
    """(2, 2) covariance of offset [s] and drift [s/s]."""
    used: int
    """Number of frames or events from which it was estimated."""

    def __post_init__(self) -> None:
        freeze_fields(self, "covariance")

    @property
    def offset_sd_s(self) -> float:
        """Standard deviation of the offset [s]."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def drift_sd(self) -> float:
        """Standard deviation of the drift [s/s]."""
        return float(np.sqrt(self.covariance[1, 1]))

    def instants(self, times: Floats) -> Floats:
        """Return the cameras' instants [s] of the device's times (...) [s]."""
        return np.asarray(times + self.offset_s + self.drift * times)

    def times(self, instants: Floats) -> Floats:
        """Return the device's times [s] at the cameras' instants (...) [s]."""
        return np.asarray((instants - self.offset_s) / (1 + self.drift))

    def instants_sd(self, times: Floats) -> Floats:
        """Return the standard deviation [s] of the cameras' instants of the device's times (...) [s]."""
        wrt = np.stack([np.ones_like(times), times], -1)
        return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", wrt, self.covariance, wrt)))


def clock_from_signals(
    cameras: tuple[Floats, Floats], device: tuple[Floats, Floats], *, groups: Sequence[SignalGroup] | None = None,
    sd: Floats | None = None, settings: DeviceClockSettings = DEVICE_CLOCK_DEFAULTS,
) -> DeviceClock:  # fmt: skip
    """Estimate a device's clock from signals that rise and fall together with signals of the cameras' motion.

    Offset and drift are searched on a grid by correlation, then refined by least squares in which each signal of the
    motion is a constant and a linear combination of its group's signals of the device: a gain, or the unknown axes of a
    sensor. The covariance accounts for correlation of the residuals over time ([NeweyWest1987]).

    Args:
        cameras: Times (F,) [s] and signals (F, K), in any unit; NaN where unknown.
        device: Times (N,) [s] on the device's clock and signals (N, L), in any unit.
        groups: Which signals belong together; by default those of the same number in both.
        sd: (F, K) standard deviations of the cameras' signals, in their unit; None for equal weights.
        settings: Rates and limits.

    Returns:
        The clock.

    Raises:
        ClockUndetermined: Nothing moves, the signals do not agree, or another offset fits nearly as well.
    """
    count = np.reshape(cameras[1], (len(cameras[0]), -1)).shape[1]
    groups = [SignalGroup(own=(k,), device=(k,)) for k in range(count)] if groups is None else groups
    own = _smoothed(*cameras, [each.own for each in groups], settings)
    other = _smoothed(*device, [each.device for each in groups], settings)
    span = min(own[0][-1] - own[0][0], other[0][-1] - other[0][0])
    steps = int(np.ceil(settings.largest_drift * span / settings.drift_step_s))
    rates = settings.largest_drift * np.linspace(-1, 1, 2 * steps + 1)
    tried = [_lag_costs(own, other, groups, rate, settings) for rate in rates]
    best = min(tried, key=lambda found: float(found.total.min()))
    if not np.isfinite(best.total).any():
        raise ClockUndetermined("the signals do not move or have too little in common.")
    clock = _refined_clock(own, other, groups, _sampled(cameras[0], sd, own[0]), best, settings)
    final = _lag_costs(own, other, groups, 1 / (1 + clock.drift) - 1, settings)
    _require_unique(final, clock, settings)
    apart = 2 * settings.smooth_hz
    offsets = 1 + apart * float(np.ptp(final.offsets[np.isfinite(final.total)]))
    trials = offsets * (1 + apart * 2 * settings.largest_drift * span)
    _require_significant(own, other, groups, clock, trials, settings)
    return clock


def _sampled(time: Floats, sd: Floats | None, kept: Floats) -> Floats | None:
    """Return the standard deviations (F, K) of the frames that are kept."""
    return None if sd is None else np.asarray(sd, float).reshape(len(time), -1)[np.searchsorted(time, kept)]


@dataclass(frozen=True, eq=False)
class _LagCosts:
    """The disagreement at each offset for one rate; the device's time is (1 + rate) u + offset at the instant u."""

    rate: float
    offsets: Floats
    mean: Floats
    """Logarithm of the remaining share of the variance; infinite where it is not usable."""
    total: Floats


def _smoothed(
    time: Floats, values: Floats, groups: Sequence[tuple[int, ...]], settings: DeviceClockSettings
) -> tuple[Floats, Floats]:
    """Return times and low-passed signals with mean 0 and variance 1 on average over a group.

    Signals that are constant, and those of no group, become unknown.
    """
    time, values = np.asarray(time, float), np.asarray(values, float).reshape(len(time), -1)
    if len(time) < settings.least_frames or not np.isfinite(values).any(0).all():
        raise ClockUndetermined("a signal has too few samples.")
    rate = 1 / float(np.median(np.diff(time)))
    if rate > MINIMUM_RATE_RATIO * settings.smooth_hz:
        values = low_pass(values, rate=rate, cutoff_hz=settings.smooth_hz)
        # What remains is described by far fewer samples.
        apart = max(1, int(rate / (settings.samples_per_cycle * settings.smooth_hz)))
        time, values = time[::apart], values[::apart]
    spread = np.nanstd(values, axis=0)
    moves = spread > 1e-9 * np.maximum(np.nanmax(np.abs(values), axis=0), 1e-300)
    unit = np.full(values.shape[1], np.nan)
    for each in groups:
        kept = [k for k in each if moves[k]]
        unit[kept] = np.sqrt(np.mean(np.square(spread[kept]))) if kept else np.nan
    return time, (values - np.nanmean(values, axis=0)) / unit


def _lag_costs(
    own: tuple[Floats, Floats], other: tuple[Floats, Floats], groups: Sequence[SignalGroup], rate: float,
    settings: DeviceClockSettings,
) -> _LagCosts:  # fmt: skip
    step = 1 / settings.search_hz
    moved = other[0] / (1 + rate)
    first, second = (np.arange(t[0], t[-1] + 1e-9, step) for t in (own[0], moved))
    a, b = interpolated(own[0], own[1], first), interpolated(moved, other[1], second)
    n, m = len(first), len(second)
    least = max(settings.least_frames, int(settings.least_overlap * min(n, m)))
    single = [each for each in groups if len(each.own) == len(each.device) == 1]
    scalars = a[:, [each.own[0] for each in single]], b[:, [each.device[0] for each in single]]
    several = [each for each in groups if each not in single]
    vectors = _vectors(a, [each.own for each in several]), _vectors(b, [each.device for each in several])
    mean, total = agreement_by_lag(scalars, vectors, places=True, least=least, apart=True)
    offsets = (second[0] - first[0] + np.arange(1 - n, m) * step) * (1 + rate)
    known = (total != 0) & (offsets >= settings.offsets[0]) & (offsets <= settings.offsets[1])
    return _LagCosts(rate, offsets, np.where(known, mean, np.inf), np.where(known, total, np.inf))


def _vectors(values: Floats, columns: Sequence[tuple[int, ...]]) -> Floats:
    """Return columns of values (N, K) as vectors (N, P, 3), with zeros for axes that are missing or do not move."""
    found = np.zeros((len(values), len(columns), 3))
    for number, own in enumerate(columns):
        for axis, column in enumerate(own):
            if np.isfinite(values[:, column]).any():
                found[:, number, axis] = values[:, column]
    return found


def _refined_clock(
    own: tuple[Floats, Floats], other: tuple[Floats, Floats], groups: Sequence[SignalGroup], sd: Floats | None,
    start: _LagCosts, settings: DeviceClockSettings,
) -> DeviceClock:  # fmt: skip
    """Refine offset and rate by Gauss-Newton; constants and gains of the signals are eliminated in each step."""
    time, values = own
    offset, rate = float(start.offsets[int(np.argmin(start.total))]), start.rate
    middle = float(time.mean())
    shift = offset + rate * middle
    weight = np.ones_like(values) if sd is None else 1 / sd
    prior = np.diag([0.0, settings.drift_sd**-2])
    for _ in range(settings.most_steps):
        at = time + shift + rate * (time - middle)
        found, slopes = (interpolated(other[0], other[1], at, derivative=order) for order in (0, 1))
        rows, residual = _signal_rows(values, found, slopes, weight, time - middle, groups)
        information = np.einsum("nki,nkj->ij", rows, rows) + prior
        if np.count_nonzero(residual.any(1)) < settings.least_frames or np.linalg.cond(information) > 1e12:
            raise ClockUndetermined("the signals do not move or have too little in common.")
        step = np.linalg.solve(information, np.einsum("nki,nk->i", rows, residual) - prior @ [shift, rate])
        shift, rate = shift + float(step[0]), rate + float(step[1])
        if abs(step[0]) < 1e-8 and abs(step[1]) < 1e-10:
            break
    inverse = np.linalg.inv(information)
    frames = int(np.count_nonzero(residual.any(1)))
    lags = min(round(settings.correlated_s / float(np.median(np.diff(time)))), frames // 4)
    scatter = long_run_variance(np.einsum("nki,nk->ni", rows, residual), lags)
    # As the smooth weights of the lags count too little, the variance of few independent blocks is enlarged.
    scatter = scatter * frames / max(frames - 2 * lags - 4, 1)
    spread = inverse @ (scatter + prior) @ inverse + np.diag([settings.repeated_sd_s**2, 0.0])
    slope = 1 + rate
    wrt = np.array([[-1 / slope, (middle + shift) / slope**2], [0.0, -1 / slope**2]])
    return DeviceClock(
        offset_s=(rate * middle - shift) / slope, drift=1 / slope - 1, covariance=wrt @ spread @ wrt.T, used=frames
    )  # fmt: skip


def _signal_rows(
    values: Floats, found: Floats, slope: Floats, weight: Floats, late: Floats, groups: Sequence[SignalGroup]
) -> tuple[Floats, Floats]:
    """Return derivatives (F, K, 2) by shift and rate and residuals (F, K), orthogonal to constants and gains."""
    rows, residuals = np.zeros((*values.shape, 2)), np.zeros(values.shape)
    for k, device in _columns(found, groups):
        known = np.isfinite(values[:, k] + weight[:, k] + (found[:, device] + slope[:, device]).sum(axis=1))
        if known.sum() <= 3 + len(device):
            continue
        w = weight[known, k, None]
        base = w * np.column_stack([np.ones(len(w)), found[np.ix_(known, device)]])
        gains, *_ = np.linalg.lstsq(base, w[:, 0] * values[known, k], rcond=None)
        moving = w * (slope[np.ix_(known, device)] @ gains[1:])[:, None]
        change = moving * np.column_stack([np.ones(len(w)), late[known]])
        rows[known, k] = change - base @ np.linalg.lstsq(base, change, rcond=None)[0]
        residuals[known, k] = w[:, 0] * values[known, k] - base @ gains
    spread = np.sqrt((residuals**2).sum(0) / np.maximum((residuals != 0).sum(0), 1))
    spread = np.maximum(spread, 1e-9)
    return rows / spread[:, None], residuals / spread


def _columns(found: Floats, groups: Sequence[SignalGroup]) -> Iterator[tuple[int, list[int]]]:
    """Iterate over the motion's signals, each with those of the device's signals (N, L) in its group that move."""
    for group in groups:
        device = [k for k in group.device if np.isfinite(found[:, k]).any()]
        for k in group.own if device else ():
            yield k, device


def _require_unique(costs: _LagCosts, clock: DeviceClock, settings: DeviceClockSettings) -> None:
    """Raise unless one offset agrees well, and clearly better than all others."""
    found = -clock.offset_s / (1 + clock.drift)
    apart = np.abs(costs.offsets - found)
    near = costs.mean[apart < settings.rival_apart_s]
    if not len(near) or not near.min() < np.log(settings.largest_left):
        raise ClockUndetermined("the signals do not agree at any offset.")
    best = max(float(near.min()), float(np.log(settings.least_left)))
    rivals = (apart >= settings.rival_apart_s) & (costs.mean < best + np.log(settings.rival_ratio))
    rivals &= (costs.mean <= np.roll(costs.mean, 1)) & (costs.mean <= np.roll(costs.mean, -1))
    if rivals.any():
        other = float(costs.offsets[rivals][np.argmin(costs.mean[rivals])] - found)
        raise ClockUndetermined(f"the motion is periodic, an offset {abs(other):.2f} s away fits as well.")


def _require_significant(
    own: tuple[Floats, Floats], other: tuple[Floats, Floats], groups: Sequence[SignalGroup], clock: DeviceClock,
    trials: float, settings: DeviceClockSettings,
) -> None:  # fmt: skip
    """Raise if signals with as few independent samples would agree as well by chance.

    Of n independent samples without a relation, the squared correlation exceeds r2 with the probability
    (1 - r2)^((n - 2) / 2), and where the axes of a sensor were turned, which is one more unknown for each of them, with
    (1 - r2)^((n - 3) / 2). The number of independent samples of smooth signals is that of [Bartlett1946]; offsets and
    rates that are searched count as independent trials if half a period of the cut-off lies between them.
    """
    found = interpolated(other[0], other[1], clock.times(own[0]))
    probability = np.log(trials)
    for group in groups:
        first, second = _in_same_axes(own[1], found, group)
        unknowns = 2.0 if len(group.own) == 1 else 3.0
        for a, b in zip(first.T, second.T, strict=True):
            known = np.isfinite(a + b)
            if np.count_nonzero(known) > 4 and np.ptp(a[known]) * np.ptp(b[known]) > 0:
                share, count = _unexplained(a[known], b[known])
                probability += 0.5 * max(count - unknowns, 0.0) * np.log(max(share, 1e-12))
    if probability > np.log(settings.chance):
        raise ClockUndetermined("the signals have so little in common that unrelated ones could agree as well.")


def _in_same_axes(own: Floats, found: Floats, group: SignalGroup) -> tuple[Floats, Floats]:
    """Return the signals of a group, (F, 1) or (F, 3), those of the device turned into the axes of the motion's."""
    if len(group.own) == len(group.device) == 1:
        return own[:, group.own], found[:, group.device]
    first, second = _vectors(own, [group.own])[:, 0], _vectors(found, [group.device])[:, 0]
    known = np.isfinite(first + second).all(axis=1)
    a, b = (values[known] - values[known].mean(axis=0) for values in (first, second))
    left, _, right = np.linalg.svd(a.T @ b)
    return first, second @ (left @ right).T


def _unexplained(first: Floats, second: Floats) -> tuple[float, float]:
    """Return the share of the variance that a correlation leaves, and the number of independent samples."""
    first, second = ((values - values.mean()) / max(float(values.std()), 1e-12) for values in (first, second))
    count = len(first)
    own, other = (np.correlate(values, values, "full")[count - 1 :] / count for values in (first, second))
    alike = 1.0 + 2.0 * float(own[1:] @ other[1:])
    return 1.0 - float(np.mean(first * second)) ** 2, count / max(alike, 1.0)


def clock_from_events(
    cameras: Floats, device: Floats, *, settings: DeviceClockSettings = DEVICE_CLOCK_DEFAULTS
) -> DeviceClock:
    """Estimate a device's clock from instants of the same events, such as foot contacts, some missing in either list.

    Args:
        cameras: (M,) instants on the cameras' clock [s].
        device: (N,) times on the device's clock [s].
        settings: Limits.

    Returns:
        The clock.

    Raises:
        ClockUndetermined: Too few events match, or those shifted by some events match about as well.
    """
    own, other = np.sort(np.asarray(cameras, float)), np.sort(np.asarray(device, float))
    if min(len(own), len(other)) < settings.least_events:
        raise ClockUndetermined(f"fewer than {settings.least_events} events.")
    count = int(np.ceil(settings.largest_drift * (other[-1] - other[0]) / settings.match_s))
    tried = []
    for drift in np.linspace(-1, 1, 2 * count + 1) * settings.largest_drift:
        moved = other * (1 + drift)
        for offset in (own[:, None] - moved).ravel():
            i, j = _matched(own, moved + offset, settings.match_s)
            tried.append((len(i), -float(((own[i] - moved[j] - offset) ** 2).sum()), offset, drift))
    best = max(tried)
    offset, drift = best[2:]
    middle = float(other.mean())
    apart = [count for count, _, o, d in tried if abs(o - offset + (d - drift) * middle) > 2 * settings.match_s]
    if best[0] < settings.least_events:
        raise ClockUndetermined("too few events match.")
    if max(apart, default=0) >= settings.event_rival * best[0]:
        raise ClockUndetermined("the events are regular, another offset matches about as many.")
    return _fitted_events(own, other, (offset, drift), settings)


def _matched(own: Floats, moved: Floats, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of events that are each other's nearest within a tolerance [s]."""
    distance = np.abs(own[:, None] - moved)
    nearest = distance.argmin(1)
    i = np.arange(len(own))
    mutual = (distance.argmin(0)[nearest] == i) & (distance[i, nearest] <= tolerance)
    return i[mutual], nearest[mutual]


def _fitted_events(
    own: Floats, other: Floats, start: tuple[float, float], settings: DeviceClockSettings
) -> DeviceClock:
    """Fit a line to the matched events and match again until nothing changes."""
    offset, drift = start
    before = None
    for _ in range(settings.most_steps):
        i, j = _matched(own, other * (1 + drift) + offset, settings.match_s)
        if len(i) < settings.least_events:
            raise ClockUndetermined("too few events match.")
        rows = np.stack([np.ones(len(j)), other[j]], 1)
        offset, drift = np.linalg.lstsq(rows, own[i] - other[j], rcond=None)[0]
        if before is not None and np.array_equal(before, (i, j)):
            break
        before = (i, j)
    residual = own[i] - other[j] - rows @ np.array([offset, drift])
    freedom = len(i) - 2
    # Few events: the standard deviation gives the 95 % interval of Student's distribution with 1.96.
    variance = float(residual @ residual) / freedom * float(special.stdtrit(freedom, 0.975) / 1.96) ** 2
    return DeviceClock(offset_s=float(offset), drift=float(drift), used=len(i),
                       covariance=variance * np.linalg.inv(rows.T @ rows))  # fmt: skip


def resampled_signal(
    device: tuple[Floats, Floats], clock: DeviceClock, instants: Floats, *, variance: float | Floats = 0.0
) -> tuple[Floats, Floats]:
    """Resample a device's signals at the cameras' instants, with their variance.

    The variance is that of a sample, plus the square of the difference between cubic and linear interpolation, a bound
    of the error of interpolation, plus the variance of the instant times the squared slope.

    Args:
        device: Times (N,) [s] on the device's clock and signals (N, K), in any unit; NaN where unknown.
        clock: The device's clock.
        instants: (F,) on the cameras' clock [s].
        variance: Variance of one sample, of all signals or (K,), in the signals' unit squared.

    Returns:
        Signals (F, K) and their variances (F, K); NaN across gaps and beyond the ends.
    """
    time, values = device
    at = clock.times(np.asarray(instants, float))
    cubic = interpolated(time, values, at)
    between = cubic - interpolated(time, values, at, cubic=False)
    slope = interpolated(time, values, at, derivative=1)
    late = clock.instants_sd(at)[:, None] / (1 + clock.drift)
    return cubic, np.asarray(variance + between**2 + (late * slope) ** 2)
