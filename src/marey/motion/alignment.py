"""Alignment of two recordings of one motion: the shift of their clocks and the rigid offset of their laboratories."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.geometry import rotations
from marey.geometry.continuity import continuous_angles
from marey.geometry.rigid import RigidTransform
from marey.motion.filters import MINIMUM_RATE_RATIO, low_pass
from marey.motion.recording import Recording, interpolated
from marey.motion.shift_search import MINIMUM_SINGULAR_RATIO, agreement_by_lag

_SHIFT_TOLERANCE_S = 1e-7
"""A smaller step of the shift ends the iteration [s]; numerical."""
_OFFSET_TOLERANCE = 1e-9
"""A smaller step of the offset ends the iteration [rad or m]; numerical."""
REPEATED_SD_S = 1e-3
"""Standard deviation of a shift of the clocks beside that from the residuals [s]: errors of a captured motion that
repeat with each step or jump are not averaged over them. The most probable value for 97 made gyroscopes, accelerometers
and goniometers and five takes (`bench run capture/devices`), 0.8 to 1.1 ms without one of the four motions. Of the
errors of that motion, 91 % are then within 1.96 standard deviations instead of 79 %."""
TWO_CLOCKS_SD = 1.64e-4
"""Standard deviation of the difference of the rates of two clocks [s/s]: the median error of the clocks of 20 000
computers was 78 parts per million ([Mills2006]), that of the difference of two is then 111."""
_OFFSET_PARAMETERS = 6
"""Number of parameters of the rigid offset."""


@dataclass(frozen=True, kw_only=True)
class AlignmentSettings:
    """Settings of the alignment of two recordings.

    The defaults were chosen by hand; results were not measured against other values.
    """

    search_hz: float = 50.0
    """Highest rate of the grid on which the shift is searched before its refinement [Hz]."""
    least_overlap: float = 0.5
    """Smallest overlap as a share of the shorter recording."""
    smooth_hz: float = 10.0
    """Cut-off of the low-pass filter applied before differentiation [Hz]."""
    rival_ratio: float = 1.3
    """A second shift is reported if its mean squared difference is at most this multiple of the best one's."""
    rival_apart_s: float = 0.15
    """Smallest difference between the best shift and a second one [s]."""
    most_steps: int = 12
    """Most Gauss-Newton steps of the refinement."""
    least_frames: int = 4
    """Fewest common frames of an alignment."""
    largest_shift_sd: float = 0.25
    """Largest standard deviation of a usable shift as a share of the shorter recording."""
    velocity_step_s: float = 0.02
    """Half the time over which angular velocities are computed [s]."""
    uncorrelated: float = 0.05
    """Autocorrelation below which differences count as uncorrelated."""
    repeated_sd_s: float = REPEATED_SD_S
    """Standard deviation of the shift by errors that repeat with each step [s]."""
    drift_sd: float = TWO_CLOCKS_SD
    """Standard deviation of the drift of the clocks, which is not estimated [s/s]."""


ALIGNMENT_DEFAULTS = AlignmentSettings()
"""Default settings of the alignment of two recordings."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Alignment:
    """The alignment of the second recording's clock and laboratory with the first's."""

    shift_s: float
    """Time t of the first recording corresponds to time t + shift of the second [s]."""
    shift_sd_s: float
    """Standard deviation of the shift [s], the root mean square over the common time if the clocks drift; NaN if it was
    given or could not be estimated."""
    rival_s: float
    """Another shift with a nearly equal fit, as for a periodic motion [s]; NaN if there is none."""
    first_from_second: RigidTransform
    """Transforms the second laboratory into the first."""
    covariance: Floats
    """(6, 6) covariance of a small rotation about the first laboratory's axes [rad] and of the translation [m]; NaN if
    the offset was given or could not be estimated. With orientations only, the part of the translation is NaN."""
    residual_m: float
    """Root mean square distance of the common points after alignment [m]; NaN without points."""
    notes: tuple[str, ...] = ()
    """What could not be estimated, one sentence each."""

    def __post_init__(self) -> None:
        freeze_fields(self, "covariance")

    @property
    def turn_sd(self) -> Floats:
        """(3,) standard deviation of the rotation [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def translation_sd(self) -> Floats:
        """(3,) standard deviation of the translation [m]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))


@dataclass(frozen=True, eq=False)
class _RecordingPair:
    """Two recordings as columns: scalars that may differ by a constant, and vectors in two laboratories."""

    time: tuple[Floats, Floats]
    scalars: tuple[Floats, Floats]
    """(F, K)."""
    vectors: tuple[Floats, Floats]
    """(F, P, 3)."""
    places: bool
    """Whether the vectors are positions, which may differ by a translation, rather than angular velocities."""
    settings: AlignmentSettings

    @property
    def spans(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return tuple((float(t[0]), float(t[-1])) for t in self.time)  # type: ignore[return-value]


def align(
    first: Recording,
    second: Recording,
    *,
    shift_s: float | None = None,
    same_laboratory: bool = False,
    settings: AlignmentSettings = ALIGNMENT_DEFAULTS,
) -> Alignment:
    """Estimate the time shift and the rigid offset of the laboratories from the quantities of the same names.

    The shift is first searched over all overlaps of at least half of the shorter recording, then refined together with
    the offset by least squares: each angle may differ by a constant, common points are transformed from one laboratory
    to the other, and every angle and point is weighted by its agreement. If only orientations are in common, angular
    velocities are used instead of points: they do not depend on the definition of a segment's frame. The standard
    deviations account for correlation between frames ([NeweyWest1987]), for angles that imply different shifts, and for
    joint centres that the two systems define differently; that of the shift also for errors of a captured motion that
    repeat with each step, and for clocks that drift.

    Args:
        first: A recording.
        second: Another recording with the same names.
        shift_s: The shift if it is known [s].
        same_laboratory: True if both recordings are in the same laboratory frame.
        settings: Rates, limits and numbers of steps.

    Returns:
        The alignment.
    """
    notes: list[str] = []
    pair = _pair(first, second, settings)
    searched = (0.0, np.nan) if shift_s is not None else _search(pair)
    if searched is None:
        notes.append("No time shift could be estimated: the motions have too little in common.")
    shift, rival = searched or (0.0, np.nan)
    shift = shift if shift_s is None else shift_s
    offset = RigidTransform.identity() if same_laboratory else _offset(pair, shift)
    if offset is None and any(v.shape[1] for v in pair.vectors):
        notes.append("The offset of the laboratories cannot be estimated: no three non-collinear points are in common.")
    free_shift = shift_s is None and searched is not None
    free_offset = not same_laboratory and offset is not None
    start = Alignment(
        shift_s=shift, shift_sd_s=np.nan, rival_s=rival, first_from_second=offset or RigidTransform.identity(),
        covariance=np.full((6, 6), np.nan), residual_m=np.nan, notes=tuple(notes),
    )  # fmt: skip
    result = _refined(pair, start, free_shift=free_shift, free_offset=free_offset)
    span = min(b - a for a, b in pair.spans)
    if free_shift and not result.shift_sd_s < settings.largest_shift_sd * span:
        note = "No time shift could be estimated: no common quantity moves."
        start = replace(start, shift_s=0.0, rival_s=np.nan, notes=(*notes, note))
        result = _refined(pair, start, free_shift=False, free_offset=free_offset)
    return result


def _pair(first: Recording, second: Recording, settings: AlignmentSettings) -> _RecordingPair:
    scalars = (continuous_angles(first.angles), continuous_angles(second.angles))
    if first.point_names or not first.segment_names:
        return _RecordingPair((first.time, second.time), scalars, (first.points, second.points), True, settings)
    return _RecordingPair(
        (first.time, second.time), scalars,
        (_angular_velocities(first, settings), _angular_velocities(second, settings)), False, settings,
    )  # fmt: skip


def _angular_velocities(recording: Recording, settings: AlignmentSettings) -> Floats:
    """Compute the segments' angular velocities in the laboratory (F, S, 3) [rad/s], smoothed."""
    step = max(1, round(settings.velocity_step_s * recording.rate))
    turn = recording.rotation
    velocity = np.full((*turn.shape[:2], 3), np.nan)
    if len(turn) > 2 * step:
        between = turn[2 * step :] @ np.swapaxes(turn[: -2 * step], -1, -2)
        spans = recording.time[2 * step :] - recording.time[: -2 * step]
        velocity[step:-step] = rotations.log(between) / spans[:, None, None]
    return _smooth(velocity, recording.rate, settings.smooth_hz)


def _smooth(values: Floats, rate: float, cutoff_hz: float) -> Floats:
    return low_pass(values, rate=rate, cutoff_hz=cutoff_hz) if rate > MINIMUM_RATE_RATIO * cutoff_hz else values


def _search(pair: _RecordingPair) -> tuple[float, float] | None:
    """Search the shift [s] on a grid, and another one with a nearly equal fit; None without common data."""
    settings = pair.settings
    step = 1 / min(settings.search_hz, *(1 / float(np.median(np.diff(t))) for t in pair.time if len(t) > 1))
    grids = [np.arange(a, b + 0.5 * step, step) for a, b in pair.spans]
    scalars = [interpolated(t, v, g) for t, v, g in zip(pair.time, pair.scalars, grids, strict=True)]
    vectors = [interpolated(t, v, g) for t, v, g in zip(pair.time, pair.vectors, grids, strict=True)]
    n, m = (len(g) for g in grids)
    least = max(settings.least_frames, int(settings.least_overlap * min(n, m)))
    costs, totals = agreement_by_lag(
        (scalars[0], scalars[1]), (vectors[0], vectors[1]), places=pair.places, least=least
    )  # fmt: skip
    lags = np.arange(1 - n, m)
    overlap = np.minimum(n, m - lags) - np.maximum(0, -lags)
    costs, totals = (np.where(overlap >= least, values, np.inf) for values in (costs, totals))
    if not np.isfinite(costs).any():
        return None
    best = int(np.argmin(totals))
    zero = pair.spans[1][0] - pair.spans[0][0]
    low = (costs <= np.roll(costs, 1)) & (costs <= np.roll(costs, -1))
    low &= np.abs(lags - lags[best]) * step > settings.rival_apart_s
    near = np.flatnonzero(low & (costs < costs[best] + np.log(settings.rival_ratio)))
    rival = zero + lags[near[np.argmin(costs[near])]] * step if len(near) else np.nan
    return float(zero + lags[best] * step), float(rival)


def _both(p: Floats, q: Floats) -> Mask:
    """Find where vectors (..., 3) are known in both recordings."""
    return np.asarray(np.isfinite(p + q).all(-1))


def _kabsch(p: Floats, q: Floats, places: bool) -> RigidTransform | None:
    """Align vectors q (n, 3) with p (n, 3) by a rotation, and a translation if they are positions."""
    mean_p, mean_q = (p.mean(0), q.mean(0)) if places else (np.zeros(3), np.zeros(3))
    cross = (p - mean_p).T @ (q - mean_q)
    sizes = np.linalg.svd(cross, compute_uv=False)
    if not sizes[1] > MINIMUM_SINGULAR_RATIO * sizes[0]:
        return None
    turn = rotations.nearest(cross)
    return RigidTransform(turn, mean_p - turn @ mean_q)


def _offset(pair: _RecordingPair, shift: float) -> RigidTransform | None:
    time = _common_time(pair, shift)
    p = interpolated(pair.time[0], pair.vectors[0], time)
    q = interpolated(pair.time[1], pair.vectors[1], time + shift)
    both = _both(p, q)
    return _kabsch(p[both], q[both], pair.places) if both.sum() >= pair.settings.least_frames else None


def _common_time(pair: _RecordingPair, shift: float) -> Floats:
    return common_time(*pair.time, shift)


def common_time(first: Floats, second: Floats, shift_s: float) -> Floats:
    """Return the times of the slower recording covered by both, on the first one's clock (N,) [s]."""
    moved = second - shift_s
    steps = [np.median(np.diff(t)) if len(t) > 1 else np.inf for t in (first, second)]
    time = first if steps[0] >= steps[1] else moved
    return np.asarray(time[(time >= max(first[0], moved[0]) - 1e-9) & (time <= min(first[-1], moved[-1]) + 1e-9)])


def _refined(pair: _RecordingPair, start: Alignment, *, free_shift: bool, free_offset: bool) -> Alignment:
    """Refine shift and offset together by Gauss-Newton, with the covariance of the free parameters."""
    shift, offset = start.shift_s, start.first_from_second
    smooth = _rates_of_change(pair)
    free = np.array([free_shift] + [free_offset] * 3 + [free_offset and pair.places] * 3)
    before = np.inf
    for _ in range(pair.settings.most_steps):
        system = _system(pair, smooth, shift, offset)
        if system is None:
            return start
        step = np.zeros(7)
        if free.any():
            step[free] = np.linalg.lstsq(system.information[np.ix_(free, free)], system.gradient[free], rcond=1e-12)[0]
        if not free.any() or system.cost > before * (1 + 1e-6):
            break
        before = system.cost
        shift += step[0]
        turn = rotations.exp(step[1:4])
        # The rotation acts about the mean of the points, so that it moves them little.
        moved = turn @ (offset.translation - system.middle) + system.middle + step[4:]
        offset = RigidTransform(rotations.nearest(turn @ offset.rotation), moved)
        if abs(step[0]) < _SHIFT_TOLERANCE_S and np.abs(step[1:]).max() < _OFFSET_TOLERANCE:
            break
    final = _system(pair, smooth, shift, offset)
    if final is None:
        return start
    more = pair.settings.repeated_sd_s**2 + (pair.settings.drift_sd * np.ptp(_common_time(pair, shift))) ** 2 / 12
    return _with_spread(start, final, shift, offset, free, places=pair.places, shift_variance=float(more))


def _rates_of_change(pair: _RecordingPair) -> tuple[Floats, Floats]:
    """Return the second recording's scalars and vectors, smoothed for differentiation."""
    rate = 1 / float(np.median(np.diff(pair.time[1]))) if len(pair.time[1]) > 1 else 0.0
    cutoff_hz = pair.settings.smooth_hz
    return _smooth(pair.scalars[1], rate, cutoff_hz), _smooth(pair.vectors[1], rate, cutoff_hz)


@dataclass(frozen=True, eq=False)
class _AlignmentEquations:
    """Normal equations of shift, rotation and translation, with the contribution of each frame."""

    information: Floats
    """(7, 7) normal matrix."""
    gradient: Floats
    """(7,) gradient of the cost."""
    scores: Floats
    """(N, 7) contribution of each frame to the gradient, from differences minus their mean over the frames."""
    constant: Floats
    """(7, 7) variance of the gradient due to constant differences of points."""
    disagreement: float
    """Variance of the gradient by the shift, from angles and points that imply different shifts."""
    lasting: int
    """Number of frames over which differences are correlated."""
    middle: Floats
    """(3,) mean of the points in the first laboratory [m]."""
    cost: float
    """Geometric mean of the residuals' standard deviations."""
    distance: float
    """Root mean square of the vectors' differences."""


def _system(
    pair: _RecordingPair, smooth: tuple[Floats, Floats], shift: float, offset: RigidTransform
) -> _AlignmentEquations | None:
    time = _common_time(pair, shift)
    if len(time) < pair.settings.least_frames:
        return None
    then = time + shift
    a, b = interpolated(pair.time[0], pair.scalars[0], time), interpolated(pair.time[1], pair.scalars[1], then)
    p = interpolated(pair.time[0], pair.vectors[0], time)
    q = offset.apply(interpolated(pair.time[1], pair.vectors[1], then))
    slope = interpolated(pair.time[1], smooth[0], then, derivative=1)
    speed = interpolated(pair.time[1], smooth[1], then, derivative=1) @ offset.rotation.T
    parts = [_scalar_rows(a - b, slope)]
    known = _both(p, q + speed)
    middle = q[known].mean(0) if pair.places and known.any() else np.zeros(3)
    parts += [_vector_rows(p - q, q - middle, speed, known)]
    columns = np.concatenate([rows for rows, _, _ in parts], 1)
    residuals = np.concatenate([r for _, r, _ in parts], 1)
    sigma = np.concatenate([s for _, _, s in parts])
    whitened, wrt = residuals / sigma, columns / sigma[:, None]
    gradient = np.einsum("nrk,nr->k", wrt, whitened)
    pulls = np.einsum("nr,nr->r", wrt[..., 0], whitened)
    pulls = np.concatenate([pulls[: a.shape[1]], pulls[a.shape[1] :].reshape(-1, 3).sum(1)])
    disagreement = float((pulls**2).sum() * len(pulls) / max(len(pulls) - 1, 1))
    there = np.concatenate([np.isfinite(a - b) & np.isfinite(slope), np.repeat(known, 3, axis=1)], 1)
    counts = np.maximum(there.sum(0), 1)
    varying = np.where(there, whitened - whitened.sum(0) / counts, 0.0)
    lasting = _lasting(varying, pair.settings.uncorrelated)
    constant = _constant_share(residuals, varying * sigma, counts, columns / sigma[:, None] ** 2, a.shape[1], lasting)
    distance = float(np.sqrt(np.mean(np.sum((p - q)[known] ** 2, -1)))) if known.any() else np.nan
    used = max(np.count_nonzero(residuals), 1)
    return _AlignmentEquations(
        information=np.einsum("nrk,nrl->kl", wrt, wrt), gradient=gradient, constant=constant, lasting=lasting,
        disagreement=disagreement,
        scores=np.einsum("nrk,nr->nk", wrt, varying), middle=middle, distance=distance,
        cost=float(np.exp(np.sum((residuals != 0) * np.log(sigma)) / used)),
    )  # fmt: skip


def _scalar_rows(difference: Floats, slope: Floats) -> tuple[Floats, Floats, Floats]:
    """Return derivatives (N, K, 7), residuals (N, K) and their spread (K,), without a constant of each column."""
    known = np.isfinite(difference) & np.isfinite(slope)
    counts = np.maximum(known.sum(0), 1)
    residual = np.where(known, difference, 0.0)
    residual = np.where(known, residual - residual.sum(0) / counts, 0.0)
    change = np.where(known, slope, 0.0)
    change = np.where(known, change - change.sum(0) / counts, 0.0)
    rows = np.zeros((*residual.shape, 7))
    rows[..., 0] = change
    return rows, residual, _spread(np.sqrt((residual**2).sum(0) / counts))


def _vector_rows(difference: Floats, arm: Floats, speed: Floats, known: Mask) -> tuple[Floats, Floats, Floats]:
    """Return derivatives (N, 3 P, 7), residuals (N, 3 P) and their spread (3 P,)."""
    frames, count = known.shape
    rows = np.zeros((frames, count, 3, 7))
    rows[..., 0] = np.where(known[..., None], speed, 0.0)
    rows[..., 1:4] = np.where(known[..., None, None], -rotations.hat(np.where(known[..., None], arm, 0.0)), 0.0)
    rows[..., 4:] = known[..., None, None] * np.eye(3)
    residual = np.where(known[..., None], difference, 0.0)
    each = np.sqrt((residual**2).sum((0, 2)) / np.maximum(3 * known.sum(0), 1))
    return rows.reshape(frames, -1, 7), residual.reshape(frames, -1), _spread(np.repeat(each, 3))


def _spread(values: Floats) -> Floats:
    """Bound standard deviations from below, to avoid a division by zero for two equal motions."""
    return np.asarray(np.maximum(values, 1e-9))


def _lasting(residuals: Floats, uncorrelated: float) -> int:
    """Return the number of frames over which differences (N, K) are correlated: twice the decorrelation lag."""
    frames = len(residuals)
    power = float((residuals**2).sum())
    if power == 0:
        return 0
    for lag in range(1, frames // 3):
        if float((residuals[lag:] * residuals[:-lag]).sum()) < uncorrelated * power:
            return min(2 * lag, frames // 3)
    return frames // 3


def long_run_variance(scores: Floats, lasting: int) -> Floats:
    """Compute the long-run variance (K, K) of scores (N, K) with `lasting` lags ([NeweyWest1987])."""
    total = scores.T @ scores
    for lag in range(1, lasting + 1):
        product = scores[lag:].T @ scores[:-lag]
        total = total + (1 - lag / (lasting + 1)) * (product + product.T)
    return np.asarray(total)


def _constant_share(
    residuals: Floats, varying: Floats, counts: Floats, weighted: Floats, scalars: int, lasting: int
) -> Floats:
    """Return the variance (7, 7) of the gradient due to constant differences of the points between the two systems.

    The points' mean differences, beyond those explained by their variation, count as samples of one isotropic
    distribution.

    Args:
        residuals: (N, R) differences.
        varying: (N, R) differences minus each column's mean.
        counts: (R,) frames of each column.
        weighted: (N, R, 7) derivatives divided by the squared spread.
        scalars: Number of columns before the points' coordinates.
        lasting: Number of frames over which differences are correlated.
    """
    means = (residuals.sum(0) / counts)[scalars:]
    if len(means) <= _OFFSET_PARAMETERS:
        return np.zeros((7, 7))
    explained = sum(
        long_run_variance(varying[:, [r]], lasting)[0, 0] / counts[r] ** 2
        for r in range(scalars, residuals.shape[1])
    )  # fmt: skip
    spread = max(0.0, float((means**2).sum() - explained)) / (len(means) - _OFFSET_PARAMETERS)
    lever = weighted[:, scalars:].sum(0)
    return np.asarray(spread * lever.T @ lever)


def _with_spread(
    start: Alignment, system: _AlignmentEquations, shift: float, offset: RigidTransform, free: Mask, *, places: bool,
    shift_variance: float,
) -> Alignment:  # fmt: skip
    """State the result with its covariance; the shift has a variance beside that from the residuals [s2]."""
    covariance = np.full((7, 7), np.nan)
    if free.any():
        at = np.ix_(free, free)
        information = system.information[at]
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        if np.linalg.cond(information / np.outer(scale, scale)) < 1e12 and (np.diag(information) > 1e-12).all():
            inverse = np.linalg.inv(information)
            scatter = long_run_variance(system.scores[:, free], system.lasting) + system.constant[at]
            if free[0]:
                scatter[0, 0] = max(scatter[0, 0], system.disagreement)
            covariance[at] = inverse @ scatter @ inverse
    # From a translation of the points' mean to one of the laboratory's origin.
    wrt = np.eye(6)
    wrt[3:, :3] = rotations.hat(system.middle - offset.translation)
    moved = covariance[1:, 1:]
    known = np.isfinite(np.diag(moved))
    if known.all():
        moved = wrt @ moved @ wrt.T
    return replace(
        start, shift_s=float(shift), shift_sd_s=float(np.sqrt(covariance[0, 0] + shift_variance)),
        first_from_second=offset, covariance=moved, residual_m=system.distance if places else np.nan,
    )  # fmt: skip
