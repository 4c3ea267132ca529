"""Offsets and drifts of all cameras below a frame, by robust least squares over all epipolar signals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.fit.clocks.comparison import ComparedSignals, SampledSignal
from marey.fit.clocks.lags import BLOCK_S
from marey.fit.solver.weights import geman_mcclure

DRIFT_SD = 3e-4
"""Standard deviation of a drift before it is measured [s/s]. The median error of the clocks of 20 000 computers was 78
parts per million ([Mills2006]), so that two of them differ by 164 (standard deviation of a normal distribution); most
of 1825 devices were within 100 ([Jiao2011]), most of 47 smartphones within 20 ([Akhmetyanov2021]). A camera of 29.97 Hz
whose file states 30 Hz, however, differs by 1000; 300 leaves room for it, and was chosen by hand: 164 in 93 % of the
cameras and 1000 in the others would make it. Drifts of 20, 100, 164 and 250 parts per million (standard deviation) that
were planted in four takes are all within the stated intervals of 95 %, with 200 in place of 300, too; but then a drift
of 1000 that three flashes show is stated four standard deviations too small."""
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
CHANGE_S = 0.5
"""Time over which differences that all joints of one camera share are alike [s]: about a step, as for `BLOCK_S`. With
0.3 to 2 s, the same errors are explained about equally well."""
_MEDIAN_TO_DEVIATION = 1.4826
"""Ratio of a normal distribution's standard deviation to its median absolute deviation."""
_STEPS_PER_CHANGE = 10
"""Number of instants per `CHANGE_S` at which differences that change slowly are summed; numerical."""
_LARGEST_OFFSET_S = 100.0
"""Standard deviation of an offset before it is measured [s]: any."""
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
    cameras: tuple[int, int]
    """The two cameras."""
    change_px: float
    """Standard deviation of the difference that the signals of one camera share and that changes slowly [px]."""


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
    ([NeweyWest1987], with blocks for lags), plus that of differences that all joints of one camera share. With it, the
    result is combined with what is known of drifts before.

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
    known = 2 * (len(offset_s) - 1)
    inverse = np.linalg.inv(information)[:known]
    clocks, covariance = _combined(found.vector()[:known], inverse, equations, prior)
    found.offset_s[1:], found.drift[1:] = np.split(clocks, 2)
    return ClockFit(found.offset_s, found.drift, covariance, _residual_px(equations, found.sd_px))


def _prior(count: int, signals: Sequence[SampledSignal]) -> Floats:
    """Return the information (P,) about the unknowns before the measurement."""
    biases = np.array([signal.bias_px for signal in signals])
    return np.concatenate([np.full(count - 1, _WEAK), np.full(count - 1, 1 / DRIFT_SD**2), 1 / biases**2])


def _linearized(signals: Sequence[SampledSignal], at: _Unknowns, *, settled: bool) -> list[_Equations]:
    equations: list[_Equations] = []
    constant = _usual_constant(signals, at)
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
        equations.append(
            _Equations(
                _jacobian(signal, k, seen, known, at), residual[known], weight, instants, signal.cameras,
                signal.change * constant,
            )
        )  # fmt: skip
    return equations


def _usual_constant(signals: Sequence[SampledSignal], at: _Unknowns) -> float:
    """Return the standard deviation of the constant differences of signals that also change slowly [px]."""
    own = [abs(bias) for signal, bias in zip(signals, at.bias_px, strict=True) if signal.change]
    return _MEDIAN_TO_DEVIATION * float(np.median(own)) if own else 0.0


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


def _combined(
    fitted: Floats, inverse: Floats, equations: Sequence[_Equations], prior: Floats
) -> tuple[Floats, Floats]:  # fmt: skip
    """Combine the measurement with what is known of drifts before, each with its own precision.

    The weights of least squares take all errors as independent. With the true, larger variance of the measurement, what
    is known before counts for more: the estimate, a linear function of the clocks, is the measurement of an update by
    Bayes' rule.

    Args:
        fitted: (N,) offsets and drifts of least squares.
        inverse: (N, P) their rows of the inverse of the normal matrix.
        equations: The equations of the last step.
        prior: (P,) information about all unknowns before the measurement.

    Returns:
        (N,) offsets and drifts, and their covariance (N, N).
    """
    count = len(fitted)
    known = np.where(prior[:count] > _WEAK, prior[:count], 0.0)
    before = 1 / np.maximum(known, _LARGEST_OFFSET_S**-2)
    shrunk = np.eye(count) - inverse[:, :count] * known
    noise = _measured_covariance(inverse, equations, known, prior[count:])
    predicted = shrunk * before @ shrunk.T + noise
    gain = np.linalg.solve(predicted, shrunk * before).T
    left = np.eye(count) - gain @ shrunk
    return gain @ fitted, left * before @ left.T + gain @ noise @ gain.T


def _measured_covariance(
    inverse: Floats, equations: Sequence[_Equations], known: Floats, of_biases: Floats
) -> Floats:  # fmt: skip
    """Return the covariance (N, N) of fitted clocks by errors of the measurement, larger where blocks disagree."""
    count = len(inverse)
    own = inverse[:, :count]
    base = own - own * known @ own
    variance = np.maximum(np.diag(base), 0.0)
    sums: dict[int, Floats] = {}
    for each in equations:
        pull = each.jacobian * (each.weight * each.residual)[:, None]
        blocks = np.floor(each.instants / BLOCK_S).astype(int)
        for block in np.unique(blocks):
            sums[int(block)] = sums.get(int(block), 0.0) + pull[blocks == block].sum(axis=0)
    if len(sums) > 1:
        scatter = len(sums) / (len(sums) - 1) * sum(np.outer(each, each) for each in sums.values())
        scatter = scatter + np.diag(np.append(np.zeros(count), of_biases))
        variance = np.maximum(variance, np.diag(inverse @ scatter @ inverse.T))
    variance = variance + np.diag(_of_changes(inverse, equations))
    growth = np.sqrt(variance / np.maximum(np.diag(base), np.finfo(float).tiny))
    return np.asarray(base * growth[:, None] * growth)


def _of_changes(inverse: Floats, equations: Sequence[_Equations]) -> Floats:
    """Return the covariance (N, N) that differences cause that the signals of one camera share and that change slowly.

    The difference is a stationary process of each camera whose correlation falls exponentially over `CHANGE_S`.
    """
    changing = [each for each in equations if each.change_px]
    total = np.zeros((len(inverse), len(inverse)))
    if not changing:
        return total
    step = CHANGE_S / _STEPS_PER_CHANGE
    begin = min(float(each.instants.min()) for each in changing)
    places = [np.round((each.instants - begin) / step).astype(int) for each in changing]
    count, decay = 1 + max(int(place.max()) for place in places), np.exp(-1.0 / _STEPS_PER_CHANGE)
    for camera in {camera for each in changing for camera in each.cameras}:
        pull = np.zeros((count, inverse.shape[1]))
        for each, place in zip(changing, places, strict=True):
            if camera in each.cameras:
                sign = each.change_px if camera == each.cameras[0] else -each.change_px
                np.add.at(pull, place, sign * each.jacobian * each.weight[:, None])
        moved = pull @ inverse.T
        before = np.zeros(len(inverse))
        total += moved.T @ moved
        for own, last in zip(moved[1:], moved[:-1], strict=True):
            before = decay * (before + last)
            both = np.outer(own, before)
            total += both + both.T
    return total


def _residual_px(equations: Sequence[_Equations], sd_px: Floats) -> float:
    residual = np.concatenate([np.zeros(0), *(each.residual for each in equations)])
    weight = np.concatenate([np.zeros(0), *(each.weight for each in equations)])
    return float(np.sqrt(np.sum(weight * residual**2) / np.sum(weight))) if len(residual) else float("nan")
