"""Offsets and drifts of all cameras below a frame, by robust least squares over all epipolar signals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.fit.clocks.comparison import ComparedSignals, SampledSignal
from marey.fit.clocks.lags import BLOCK_S
from marey.fit.solver.weights import geman_mcclure

DRIFT_SD = 3e-4
"""Standard deviation of a drift before it is measured [s/s]. Quartz clocks differ by up to about 100 parts per million;
three times as much leaves room for cameras that round their frame rate. Chosen by hand."""
GAUSS_NEWTON_STEPS = 12
"""Number of Gauss-Newton steps; chosen by hand. The estimates of five rendered takes change by less than 0.001 frames
after the eighth."""
LONGEST_STEP_S = 1 / 30
"""Largest change of an offset in one step [s]. Chosen by hand."""
FIRST_SD_PX = 3.0
"""Standard deviation of all signals in the first step [px]. Chosen by hand."""
SETTLING = 3
"""Number of steps after which the standard deviations are those of the differences. Chosen by hand."""
ROBUST_SCALE_SD = 3.0
"""Scale of the robust weights, in standard deviations. Chosen by hand."""
LEAST_COMPARED = 8
"""Signals with fewer common samples are ignored. Chosen by hand."""
_MEDIAN_TO_DEVIATION = 1.4826
"""Ratio of a normal distribution's standard deviation to its median absolute deviation."""
_WEAK = 1e-6
"""Information about an offset that keeps the equations regular without any measurement [1/s2]."""


@dataclass(frozen=True, eq=False)
class ClockFit:
    """Estimated offsets and drifts of the cameras' clocks."""

    offset_s: Floats
    """(C,) offset of each clock [s]; 0 for the first camera."""
    drift: Floats
    """(C,) drift of each clock [s/s]; 0 for the first camera."""
    covariance: Floats
    """(2 C - 2, 2 C - 2) of the offsets and drifts of all cameras but the first [s, s/s]."""
    residual_px: float
    """Root mean square of the weighted differences of the signals [px]; NaN without any signal."""

    @property
    def spread(self) -> tuple[Floats, Floats]:
        """Standard deviations (C,) of the offsets [s] and of the drifts [s/s]; 0 for the first camera."""
        count = len(self.offset_s)
        sd = np.sqrt(np.diag(self.covariance))
        return np.append(0.0, sd[: count - 1]), np.append(0.0, sd[count - 1 :])


@dataclass(frozen=True, eq=False)
class _Equations:
    """Linearised differences of one signal."""

    jacobian: Floats
    """(n, P) by the unknowns."""
    residual: Floats
    """(n,) [px]."""
    weight: Floats
    """(n,) [1/px2]."""
    instants: Floats
    """(n,) on the first camera's clock [s]."""


@dataclass(eq=False)
class _Unknowns:
    """Current values: offsets and drifts of C cameras, constant differences and spreads of K signals."""

    offset_s: Floats
    drift: Floats
    bias_px: Floats
    sd_px: Floats

    def step(self, change: Floats) -> None:
        others = len(self.offset_s) - 1
        self.offset_s[1:] += np.clip(change[:others], -LONGEST_STEP_S, LONGEST_STEP_S)
        self.drift[1:] += change[others : 2 * others]
        self.bias_px += change[2 * others :]

    def vector(self) -> Floats:
        return np.concatenate([self.offset_s[1:], self.drift[1:], self.bias_px])


def fit_clocks(signals: Sequence[SampledSignal], offset_s: Floats) -> ClockFit:
    """Estimate the clocks of all cameras from approximate offsets.

    The unknowns are offset and drift of each camera but the first, and a constant difference of each signal. The
    standard deviation of each signal's differences is estimated from them. The covariance is the larger one of that of
    least squares and that of the sums of the gradient over blocks of time, in which errors may be alike
    ([NeweyWest1987], with blocks for lags).

    Args:
        signals: Signals of all pairs of cameras.
        offset_s: (C,) offsets [s], right to about a frame.

    Returns:
        The clocks.
    """
    found = _Unknowns(offset_s.astype(float), np.zeros(len(offset_s)), np.zeros(len(signals)), np.zeros(0))
    found.sd_px = np.full(len(signals), FIRST_SD_PX)
    prior = _prior(len(offset_s), signals)
    for step in range(GAUSS_NEWTON_STEPS):
        equations = _linearized(signals, found, settled=step >= SETTLING)
        information, gradient = np.diag(prior), prior * found.vector()
        gradient[: len(offset_s) - 1] = 0.0
        for each in equations:
            information += each.jacobian.T @ (each.jacobian * each.weight[:, None])
            gradient += each.jacobian.T @ (each.weight * each.residual)
        found.step(-np.linalg.solve(information, gradient))
    covariance = _covariance(np.linalg.inv(information), equations, prior)
    known = 2 * (len(offset_s) - 1)
    return ClockFit(found.offset_s, found.drift, covariance[:known, :known], _residual_px(equations, found.sd_px))


def _prior(count: int, signals: Sequence[SampledSignal]) -> Floats:
    """Return the information (P,) about the unknowns before the measurement."""
    biases = np.array([signal.bias_px for signal in signals])
    return np.concatenate([np.full(count - 1, _WEAK), np.full(count - 1, 1 / DRIFT_SD**2), 1 / biases**2])


def _linearized(signals: Sequence[SampledSignal], at: _Unknowns, *, settled: bool) -> list[_Equations]:
    equations = []
    for k, signal in enumerate(signals):
        seen = signal.compared(at.offset_s, at.drift)
        residual = seen.residual_px - at.bias_px[k]
        known = np.isfinite(residual) & np.isfinite(seen.slope)
        if np.count_nonzero(known) < LEAST_COMPARED:
            continue
        spread = _MEDIAN_TO_DEVIATION * float(np.median(np.abs(residual[known])))
        at.sd_px[k] = max(spread, signal.least_sd_px) if settled else max(0.7 * at.sd_px[k], 1.0)
        weight = geman_mcclure(residual[known], ROBUST_SCALE_SD * at.sd_px[k]) / at.sd_px[k] ** 2
        instants = seen.times[0][known] + at.offset_s[signal.cameras[0]]
        equations.append(_Equations(_jacobian(signal, k, seen, known, at), residual[known], weight, instants))
    return equations


def _jacobian(signal: SampledSignal, k: int, seen: ComparedSignals, known: Floats, at: _Unknowns) -> Floats:
    """Return the derivatives (n, P) of the differences: a later clock of the second camera moves its value back."""
    others = len(at.offset_s) - 1
    jacobian = np.zeros((np.count_nonzero(known), 2 * others + len(at.bias_px)))
    for camera, times, sign in zip(signal.cameras, seen.times, (-1.0, 1.0), strict=True):
        if camera > 0:
            jacobian[:, camera - 1] = sign * seen.slope[known]
            jacobian[:, others + camera - 1] = sign * seen.slope[known] * times[known]
    jacobian[:, 2 * others + k] = -1.0
    return jacobian


def _covariance(inverse: Floats, equations: Sequence[_Equations], prior: Floats) -> Floats:
    """Return the covariance (P, P): that of least squares, with larger standard deviations where blocks disagree."""
    sums: dict[int, Floats] = {}
    for each in equations:
        pull = each.jacobian * (each.weight * each.residual)[:, None]
        blocks = np.floor(each.instants / BLOCK_S).astype(int)
        for block in np.unique(blocks):
            sums[int(block)] = sums.get(int(block), 0.0) + pull[blocks == block].sum(axis=0)
    count = len(sums)
    if count < 2:
        return inverse
    scatter = count / (count - 1) * sum(np.outer(own, own) for own in sums.values())
    robust = inverse @ (scatter + np.diag(prior)) @ inverse
    growth = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse), 1.0))
    return np.asarray(inverse * growth[:, None] * growth)


def _residual_px(equations: Sequence[_Equations], sd_px: Floats) -> float:
    residual = np.concatenate([np.zeros(0), *(each.residual for each in equations)])
    weight = np.concatenate([np.zeros(0), *(each.weight for each in equations)])
    return float(np.sqrt(np.sum(weight * residual**2) / np.sum(weight))) if len(residual) else float("nan")
