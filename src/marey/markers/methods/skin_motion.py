"""The skin's motion over a bone as a random field over the frames: its size, and the shares of its variance.

The visible part is the deviation of a cluster from a rigid body. It determines the size of the motion, and the shares
of its variance: one follows the joint's rotation, one the time courses of a few modes that the other markers share, and
the rest is wobble with a short correlation time. The shares are those with the largest likelihood of left-out markers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.markers.data.cluster_data import ClusterData
from marey.markers.data.rigid_fit import RigidFit, fit_rigid
from marey.markers.methods.joint_constraints import CORRELATION_TIME_S

_LEAST_TURN = 1e-6
"""Mean rotation [rad] below which the joint's rotation carries no information; numerical."""
_LEAST_COURSE = 1e-9
"""RMS time course [m] below which the modes carry no information; numerical."""
_THIGH = np.log(1.5)
"""Logarithm of the size of the thigh's skin motion relative to an average segment; the thigh's skin moves about twice
as far as the shank's ([Cereatti2017])."""
_LOG_RELATIVE_SIZE = {"thigh": _THIGH, "shank": -_THIGH, "femur": _THIGH, "tibia": -_THIGH}
"""Logarithm of a segment's skin motion relative to an average segment; 0 for other segments."""
_MAXIMUM_MODES = 4
"""Most modes of a candidate model. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class SkinVarianceShares:
    """Shares of the variance of the skin's motion; the remaining share is wobble."""

    turn: float = 0.4
    """Share that follows the joint's rotation, as a random walk with independent increments."""
    modes: float = 0.0
    """Share that follows the time courses of the modes."""
    rank: int = 0
    """Number of modes."""

    @property
    def wobble(self) -> float:
        """Share with a short correlation time."""
        return 1 - self.turn - self.modes


CANDIDATE_SHARES = (
    SkinVarianceShares(turn=0.4),
    SkinVarianceShares(turn=0.8),
    *(
        SkinVarianceShares(turn=0.4, modes=modes, rank=rank)
        for rank in range(1, _MAXIMUM_MODES + 1)
        for modes in (0.2, 0.4)
    ),
)
"""The candidate shares, simplest first. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class SkinMotionSettings:
    """Settings of the estimation of the skin's motion.

    The defaults were chosen by hand; results were not measured against other values.
    """

    candidates: tuple[SkinVarianceShares, ...] = CANDIDATE_SHARES
    """Candidate shares of the variance, simplest first."""
    scored_frames: int = 40
    """Frames in which left-out markers are scored."""
    left_out_markers: int = 6
    """Most markers that are left out, one at a time."""
    markers_to_weight: int = 5
    """Fewest markers of a cluster whose markers are weighted individually."""
    largest_relative_sd: float = 3.0
    """Largest standard deviation of a marker relative to that of its cluster."""
    outlier_variance_ratio: float = 10.0
    """Variances of a frame are limited to this multiple of the median frame's."""
    shrinkage_freedom: float = 12.0
    """Degrees of freedom per frame with which a cluster's size has the same weight as the common size of all
    clusters."""


_SETTINGS = SkinMotionSettings()
"""Default settings of the estimation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinMotion:
    """Statistical model of the skin's motion over one bone, in a trial of F frames."""

    segment: str
    size: float
    """Visible root mean square displacement of a marker from the first known posture [m]."""
    freedom: int
    """Degrees of freedom per frame from which the size was estimated."""
    relative_sd: Floats
    """(M,) standard deviation of each marker relative to that of the cluster."""
    form: SkinVarianceShares
    """Shares of the variance."""
    log_likelihood: tuple[float, ...] = ()
    """Mean log likelihood per coordinate of left-out markers for each candidate; empty if there are too few markers."""
    first: int
    """Frame index of the first known posture."""
    time: Floats
    """(F,) time of each frame [s]."""
    turn: Floats
    """(F,) rotation of the joint [rad]."""
    courses: Floats
    """(F, R) time courses of the modes, largest first [m]."""

    def semivariance(self, frames: Integers, others: Integers) -> Floats:
        """Return half the variance (n, m) of the motion between frames (n,) and others (m,), relative to size squared.

        Its mean between the first known posture and all other frames is 1/2.
        """
        every = np.arange(len(self.time))
        mean = (
            self._unscaled_semivariance(every[every != self.first], np.array([self.first])).mean()
            if len(every) > 1
            else 1.0
        )
        return np.asarray(self._unscaled_semivariance(frames, others) / (2 * mean))

    def _unscaled_semivariance(self, frames: Integers, others: Integers) -> Floats:
        courses = self.courses[:, : self.form.rank]
        return mixed_semivariance(
            self.form, self.time[frames], self.turn[frames], courses[frames], self.time[others], self.turn[others],
            courses[others], _scales(self.turn, courses, self.first),
        )  # fmt: skip


def mixed_semivariance(
    form: SkinVarianceShares, time: Floats, turn: Floats, courses: Floats, other_time: Floats, other_turn: Floats,
    other_courses: Floats, scales: tuple[float, float],
) -> Floats:  # fmt: skip
    """Return the semivariance (n, m) of a model between n instants and m others; each part is 1 at its scale."""
    wobble = 1 - np.exp(-np.abs(time[:, None] - other_time) / CORRELATION_TIME_S)
    turned = np.abs(turn[:, None] - other_turn) / scales[0]
    moved = ((courses[:, None] - other_courses) ** 2).sum(-1) / scales[1]
    return np.asarray(form.wobble * wobble + form.turn * turned + form.modes * moved)


def learn_skin(
    data: ClusterData, turn: Floats, time: Floats, noise_m: float, settings: SkinMotionSettings = _SETTINGS
) -> SkinMotion:
    """Estimate a model of the skin's motion over one bone from the deviation of its cluster from a rigid body.

    Args:
        data: The cluster; displacements are relative to its first posture.
        turn: (F,) rotation of its joint [rad], finite.
        time: (F,) time of each frame [s].
        noise_m: Standard deviation of a measured coordinate [m], which is not attributed to the skin.
        settings: Settings of the estimation.

    Returns:
        The model.
    """
    relative_sd = _relative_sds(data, noise_m, settings)
    fit = fit_rigid(first_posture_shape(data), data.points, noise_m * relative_sd)
    moved = _displacements(fit)
    first = int(data.frames[0])
    size, freedom = _size(moved, first, noise_m, settings.outlier_variance_ratio)
    scored = _scored_frames(fit, first, settings.scored_frames)
    skin = SkinMotion(
        segment=data.segment, size=size, freedom=freedom, relative_sd=relative_sd, form=SkinVarianceShares(),
        first=first, time=time, turn=turn, courses=_courses(moved, _MAXIMUM_MODES),
    )  # fmt: skip
    if size == 0 or data.points.shape[1] <= 3 or len(scored) < 3:
        return skin
    likelihood = _score_candidates(data, relative_sd * noise_m, skin, scored, settings)
    if not np.isfinite(likelihood).all():
        return skin
    return replace(
        skin, form=settings.candidates[int(np.argmax(likelihood))], log_likelihood=tuple(likelihood.tolist())
    )


def shrink_sizes(skins: Sequence[SkinMotion], settings: SkinMotionSettings = _SETTINGS) -> tuple[SkinMotion, ...]:
    """Shrink the sizes of a trial's clusters towards a common size, more strongly for clusters with few markers.

    A cluster of four markers shows little of its skin's motion. The logarithms of the sizes are averaged, with the
    prior that the thigh's size is about twice the shank's. The size of a rigid cluster stays 0.

    Args:
        skins: Models of all clusters of a trial.
        settings: Settings of the estimation.

    Returns:
        The models with their new sizes.
    """
    shown = [skin for skin in skins if skin.size > 0]
    if len(shown) < 2:
        return tuple(skins)
    own = np.array([np.log(skin.size) - _log_relative_size(skin.segment) for skin in shown])
    counts = np.array([skin.freedom for skin in shown], float)
    common = float(own @ counts / counts.sum())
    weight = settings.shrinkage_freedom
    settled = (counts * own + weight * common) / (counts + weight)
    by_name = {s.segment: float(np.exp(v + _log_relative_size(s.segment))) for s, v in zip(shown, settled, strict=True)}
    return tuple(replace(skin, size=by_name.get(skin.segment, skin.size)) for skin in skins)


def first_posture_shape(data: ClusterData) -> Floats:
    """Return the cluster's shape (M, 3) [m] in the first known posture, with missing markers from the nearest one."""
    return np.asarray(filled_postures(data)[0])


def filled_postures(data: ClusterData) -> Floats:
    """Return the markers' positions (K, M, 3) [m] in the known postures; missing ones from the nearest posture."""
    postures = np.array(data.postures)
    count = len(postures)
    for marker in range(postures.shape[1]):
        known = np.flatnonzero(np.isfinite(postures[:, marker]).all(-1))
        nearest = known[np.abs(np.arange(count)[:, None] - known).argmin(1)]
        postures[:, marker] = postures[nearest, marker]
    return postures


def _log_relative_size(segment: str) -> float:
    """Return the logarithm of a segment's skin motion relative to an average segment."""
    return float(_LOG_RELATIVE_SIZE.get(segment.removeprefix("left_").removeprefix("right_"), 0.0))


def _displacements(fit: RigidFit) -> Floats:
    """Return the residuals (F, M, 3) of a rigid fit along the bone's axes [m]; NaN for unused markers."""
    return np.asarray(np.einsum("fji,fmj->fmi", fit.rotation, fit.residuals))


def _relative_sds(data: ClusterData, noise_m: float, settings: SkinMotionSettings) -> Floats:
    """Estimate the relative standard deviations (M,) of markers: the mean of their own and the cluster's variance."""
    count = data.points.shape[1]
    relative_sd = np.ones(count)
    if count < settings.markers_to_weight:
        return relative_sd
    for _ in range(3):
        moved = _displacements(fit_rigid(first_posture_shape(data), data.points, noise_m * relative_sd))
        present = np.isfinite(moved).all(-1)
        variance = np.where(present, (np.nan_to_num(moved) ** 2).sum(-1), 0.0).sum(0) / np.maximum(present.sum(0), 1)
        if variance.mean() <= noise_m**2 * 1e-6:
            return np.ones(count)
        ratio = np.sqrt((variance / variance.mean() + 1) / 2)
        relative_sd = np.minimum(ratio, settings.largest_relative_sd)
    return relative_sd


def _size(moved: Floats, first: int, noise_m: float, outlier_ratio: float) -> tuple[float, int]:
    """Return the root mean square displacement without noise [m], and its degrees of freedom per frame."""
    present: Mask = np.array(np.isfinite(moved).all(-1))
    present[first] = False
    free = 3 * present.sum(1) - 6
    usable = free > 0
    if not usable.any():
        return 0.0, 0
    squared = (np.nan_to_num(moved[usable]) ** 2 * present[usable][..., None]).sum((1, 2))
    most = outlier_ratio * np.median(squared / free[usable])
    # The reference has the same noise as the frame compared with it.
    skin = 3 * (np.minimum(squared, most * free[usable]).sum() / free[usable].sum() - 2 * noise_m**2)
    return float(np.sqrt(max(skin, 0.0))), int(np.median(free[usable]))


def _courses(moved: Floats, rank: int) -> Floats:
    """Return the time courses (F, rank) of the largest modes [m]; a missing marker counts as at rest."""
    flat = np.nan_to_num(moved).reshape(len(moved), -1)
    left, value, _ = np.linalg.svd(flat, full_matrices=False)
    courses = np.zeros((len(moved), rank))
    held = min(rank, len(value))
    courses[:, :held] = left[:, :held] * value[:held]
    unknown = ~np.isfinite(moved).any((1, 2))
    courses[unknown] = np.nan
    return without_gaps(courses)


def without_gaps(values: Floats) -> Floats:
    """Interpolate missing values of series (F, ...) over the frames; an entirely missing series becomes zero."""
    flat = np.array(values, float).reshape(len(values), -1)
    frames = np.arange(len(flat))
    for column in flat.T:
        known = np.isfinite(column)
        column[~known] = np.interp(frames[~known], frames[known], column[known]) if known.any() else 0.0
    return flat.reshape(np.shape(values))


def _scored_frames(fit: RigidFit, first: int, most: int) -> Integers:
    """Choose evenly spaced frames (n,) with an estimate, without the first known posture."""
    answered = np.flatnonzero(np.isfinite(fit.rotation).all((1, 2)) & (np.arange(len(fit.rotation)) != first))
    if len(answered) <= most:
        return answered
    return np.asarray(answered[np.linspace(0, len(answered) - 1, most).round().astype(int)])


def _score_candidates(
    data: ClusterData, sd: Floats, skin: SkinMotion, scored: Integers, settings: SkinMotionSettings
) -> Floats:
    """Return the mean log likelihood per coordinate of left-out markers for each candidate."""
    candidates = settings.candidates
    shape, count = first_posture_shape(data), data.points.shape[1]
    left_out = np.unique(np.linspace(0, count - 1, min(count, settings.left_out_markers)).round().astype(int))
    frames = np.concatenate([[skin.first], scored])
    total, coordinates = np.zeros(len(candidates)), 0
    for marker in left_out:
        rest = np.delete(np.arange(count), marker)
        fit = fit_rigid(shape[rest], data.points[frames][:, rest], sd[rest])
        place = np.einsum("fji,fj->fi", fit.rotation, data.points[frames, marker] - fit.translation)
        moved = place - shape[marker]
        known = np.isfinite(moved).all(-1)
        if known.sum() < 4 or not known[0]:
            continue
        part = replace(skin, courses=np.zeros((0, 0)), time=skin.time[frames][known], turn=skin.turn[frames][known])
        courses = _courses(_displacements(fit)[known], _MAXIMUM_MODES)
        total += [_left_out_likelihood(form, part, courses, moved[known]) for form in candidates]
        coordinates += 3 * (int(known.sum()) - 1)
    return total / coordinates if coordinates else np.full(len(candidates), np.nan)


def _left_out_likelihood(form: SkinVarianceShares, part: SkinMotion, courses: Floats, moved: Floats) -> float:
    """Return the log likelihood of a marker's displacements (n, 3) from the first of n frames, with profiled size."""
    courses = courses[:, : form.rank]
    scales = _scales(part.turn, courses, 0)
    semivariances = mixed_semivariance(form, part.time, part.turn, courses, part.time, part.turn, courses, scales)
    covariance = semivariances[1:, :1] + semivariances[:1, 1:] - semivariances[1:, 1:]
    covariance[np.diag_indices(len(covariance))] += 1e-6 * np.trace(covariance) / len(covariance)
    lower = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(lower, moved[1:] - moved[0])
    variance = (whitened**2).mean()
    return float(-3 * (len(lower) / 2 * np.log(max(variance, 1e-30)) + np.log(np.diag(lower)).sum()))


def _scales(turn: Floats, courses: Floats, first: int) -> tuple[float, float]:
    """Return the mean |rotation| and mean squared courses relative to the first posture, the scales of the shares."""
    turned = float(np.abs(turn - turn[first]).mean())
    moved = float(((courses - courses[first]) ** 2).sum(-1).mean())
    return max(turned, _LEAST_TURN), max(moved, _LEAST_COURSE**2)
