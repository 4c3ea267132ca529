"""The skin's motion over a bone as a random field over the frames: its size, and what it follows.

What a cluster shows of it is how far it does not stay rigid. Its size is learned from that, and so is its form: what
part follows the joint's turn, what part the time courses of a few modes that the other markers share, and what part is
a wobble that has forgotten itself after a moment. The form is the one under which markers that were left out are
likeliest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.markers.data.cluster_data import ClusterData
from marey.markers.data.rigid_fit import RigidFit, fit_rigid

_WOBBLE_S = 0.15
_FRAMES_JUDGED = 40
_MARKERS_LEFT_OUT = 6
_MOST_MODES = 4
_MARKERS_TO_WEIGH = 5
_LOOSEST = 3.0
_WILD = 10.0  # times the median frame's variance; what is more counts as no more
_LEAST_TURN = 1e-6  # rad; below these on the mean neither turn nor courses say anything
_LEAST_COURSE = 1e-9  # m
_THIGH = np.log(1.5)  # the thigh's skin moves about twice as far as the shank's ([Cereatti2017])
_LEVELS = {"thigh": _THIGH, "shank": -_THIGH, "femur": _THIGH, "tibia": -_THIGH}
_LEVEL_COUNTS = 12.0  # as many free coordinates as say as much of a cluster's size as its neighbours' sizes do


@dataclass(frozen=True, kw_only=True)
class SkinForm:
    """What shares of the skin's variance follow what; the rest is wobble."""

    turn: float = 0.4
    """Follows the joint's turn, each step of which adds an independent displacement."""
    modes: float = 0.0
    """Follows the time courses of the modes."""
    rank: int = 0
    """How many modes."""

    @property
    def wobble(self) -> float:
        """The share that differs from moment to moment."""
        return 1 - self.turn - self.modes


FORMS = (
    SkinForm(turn=0.4),
    SkinForm(turn=0.8),
    *(SkinForm(turn=0.4, modes=modes, rank=rank) for rank in range(1, _MOST_MODES + 1) for modes in (0.2, 0.4)),
)
"""The forms that are tried, simplest first."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinMotion:
    """What is believed of the skin's motion over one bone, in a trial of F frames."""

    segment: str
    size: float
    """Root mean square displacement of a marker since the first known posture, as far as the cluster shows it [m]."""
    freedom: int
    """How many coordinates a frame told it."""
    looseness: Floats
    """(M,) each marker's own standard deviation as a multiple of the cluster's."""
    form: SkinForm
    log_likelihood: tuple[float, ...] = ()
    """Of each of FORMS on markers left out, a coordinate; empty where too few markers are there to leave one out."""
    first: int
    """The frame of the first known posture."""
    time: Floats
    """(F,) [s]."""
    turn: Floats
    """(F,) the turn that it follows [rad]."""
    courses: Floats
    """(F, R) the time courses of the modes, largest first [m]."""

    def semivariance(self, frames: Integers, others: Integers) -> Floats:
        """Give (n, m) half the variance of the motion between frames (n,) and others (m,), in squares of the size.

        Between the first known posture and the other frames it is 1/2 on the mean.
        """
        every = np.arange(len(self.time))
        mean = self._raw(every[every != self.first], np.array([self.first])).mean() if len(every) > 1 else 1.0
        return np.asarray(self._raw(frames, others) / (2 * mean))

    def _raw(self, frames: Integers, others: Integers) -> Floats:
        courses = self.courses[:, : self.form.rank]
        return mixed(
            self.form, self.time[frames], self.turn[frames], courses[frames], self.time[others], self.turn[others],
            courses[others], _scales(self.turn, courses, self.first),
        )  # fmt: skip


def mixed(
    form: SkinForm, time: Floats, turn: Floats, courses: Floats, other_time: Floats, other_turn: Floats,
    other_courses: Floats, scales: tuple[float, float],
) -> Floats:  # fmt: skip
    """Give the semivariance (n, m) of a form between n instants and m others; each part is 1 where its scale says."""
    wobble = 1 - np.exp(-np.abs(time[:, None] - other_time) / _WOBBLE_S)
    turned = np.abs(turn[:, None] - other_turn) / scales[0]
    moved = ((courses[:, None] - other_courses) ** 2).sum(-1) / scales[1]
    return np.asarray(form.wobble * wobble + form.turn * turned + form.modes * moved)


def learn_skin(data: ClusterData, turn: Floats, time: Floats, noise_m: float) -> SkinMotion:
    """Learn the skin's motion over one bone from how far its cluster does not stay rigid.

    Args:
        data: The cluster; its first posture is the one from which displacements count.
        turn: (F,) the turn of its joint [rad], finite.
        time: (F,) [s].
        noise_m: Standard deviation of a measured coordinate [m]; what it explains is not skin motion.
    """
    looseness = _looseness(data, noise_m)
    fit = fit_rigid(shape_of(data), data.points, noise_m * looseness)
    moved = _displacements(fit)
    first = int(data.frames[0])
    size, freedom = _size(moved, first, noise_m)
    judged = _judged_frames(fit, first)
    skin = SkinMotion(
        segment=data.segment, size=size, freedom=freedom, looseness=looseness, form=SkinForm(), first=first, time=time,
        turn=turn, courses=_courses(moved, _MOST_MODES),
    )  # fmt: skip
    if size == 0 or data.points.shape[1] <= 3 or len(judged) < 3:
        return skin
    likelihood = _judge(data, looseness * noise_m, skin, judged)
    if not np.isfinite(likelihood).all():
        return skin
    return replace(skin, form=FORMS[int(np.argmax(likelihood))], log_likelihood=tuple(likelihood.tolist()))


def settle_sizes(skins: Sequence[SkinMotion]) -> tuple[SkinMotion, ...]:
    """Draw the sizes of a trial's clusters towards each other, the more the fewer markers a cluster has.

    A cluster of four shows little of its skin's motion. Sizes are compared by their logarithms, and the thigh's is
    taken to be about twice the shank's. A cluster that stays rigid stays so.
    """
    shown = [skin for skin in skins if skin.size > 0]
    if len(shown) < 2:
        return tuple(skins)
    own = np.array([np.log(skin.size) - _level(skin.segment) for skin in shown])
    counts = np.array([skin.freedom for skin in shown], float)
    common = float(own @ counts / counts.sum())
    settled = (counts * own + _LEVEL_COUNTS * common) / (counts + _LEVEL_COUNTS)
    by_name = {s.segment: float(np.exp(v + _level(s.segment))) for s, v in zip(shown, settled, strict=True)}
    return tuple(replace(skin, size=by_name.get(skin.segment, skin.size)) for skin in skins)


def shape_of(data: ClusterData) -> Floats:
    """Give (M, 3) the cluster's shape in the first known posture; a marker it lacks has its place in the next."""
    return filled_postures(data)[0]


def filled_postures(data: ClusterData) -> Floats:
    """Give (K, M, 3) the markers' places in the known postures; one missing in one has its place of the nearest."""
    postures = np.array(data.postures)
    count = len(postures)
    for marker in range(postures.shape[1]):
        known = np.flatnonzero(np.isfinite(postures[:, marker]).all(-1))
        nearest = known[np.abs(np.arange(count)[:, None] - known).argmin(1)]
        postures[:, marker] = postures[nearest, marker]
    return postures


def _level(segment: str) -> float:
    """Give the logarithm of how far a segment's skin moves, beside that of any segment."""
    return _LEVELS.get(segment.removeprefix("left_").removeprefix("right_"), 0.0)


def _displacements(fit: RigidFit) -> Floats:
    """Give (F, M, 3) the residuals of a rigid fit along the bone's axes; NaN for what was not used."""
    return np.einsum("fji,fmj->fmi", fit.rotation, fit.residuals)


def _looseness(data: ClusterData, noise_m: float) -> Floats:
    """Weigh markers by how much they move: half by their own variance, half by the cluster's."""
    count = data.points.shape[1]
    looseness = np.ones(count)
    if count < _MARKERS_TO_WEIGH:
        return looseness
    for _ in range(3):
        moved = _displacements(fit_rigid(shape_of(data), data.points, noise_m * looseness))
        present = np.isfinite(moved).all(-1)
        variance = np.where(present, (np.nan_to_num(moved) ** 2).sum(-1), 0.0).sum(0) / np.maximum(present.sum(0), 1)
        if variance.mean() <= noise_m**2 * 1e-6:
            return np.ones(count)
        looseness = np.minimum(np.sqrt((variance / variance.mean() + 1) / 2), _LOOSEST)
    return looseness


def _size(moved: Floats, first: int, noise_m: float) -> tuple[float, int]:
    """Give the root mean square displacement that is no noise [m], and in how many coordinates a frame it is seen."""
    present: Mask = np.array(np.isfinite(moved).all(-1))
    present[first] = False
    free = 3 * present.sum(1) - 6
    told = free > 0
    if not told.any():
        return 0.0, 0
    squared = (np.nan_to_num(moved[told]) ** 2 * present[told][..., None]).sum((1, 2))
    most = _WILD * np.median(squared / free[told])
    # The reference is as noisy as the frame compared with it.
    skin = 3 * (np.minimum(squared, most * free[told]).sum() / free[told].sum() - 2 * noise_m**2)
    return float(np.sqrt(max(skin, 0.0))), int(np.median(free[told]))


def _courses(moved: Floats, rank: int) -> Floats:
    """Give (F, rank) the courses of the largest modes [m]; a marker that is missing counts as at rest."""
    flat = np.nan_to_num(moved).reshape(len(moved), -1)
    left, value, _ = np.linalg.svd(flat, full_matrices=False)
    courses = np.zeros((len(moved), rank))
    held = min(rank, len(value))
    courses[:, :held] = left[:, :held] * value[:held]
    unknown = ~np.isfinite(moved).any((1, 2))
    courses[unknown] = np.nan
    return without_gaps(courses)


def without_gaps(values: Floats) -> Floats:
    """Fill what is missing of series (F, ...) from the frames beside; all of it missing, with zeros."""
    flat = np.array(values, float).reshape(len(values), -1)
    frames = np.arange(len(flat))
    for column in flat.T:
        known = np.isfinite(column)
        column[~known] = np.interp(frames[~known], frames[known], column[known]) if known.any() else 0.0
    return flat.reshape(np.shape(values))


def _judged_frames(fit: RigidFit, first: int) -> Integers:
    """Choose frames (n,) with an answer, spread evenly, without the first known posture."""
    answered = np.flatnonzero(np.isfinite(fit.rotation).all((1, 2)) & (np.arange(len(fit.rotation)) != first))
    if len(answered) <= _FRAMES_JUDGED:
        return answered
    return answered[np.linspace(0, len(answered) - 1, _FRAMES_JUDGED).round().astype(int)]


def _judge(data: ClusterData, sd: Floats, skin: SkinMotion, judged: Integers) -> Floats:
    """Give the mean log likelihood, a coordinate, of markers left out under each of the forms."""
    shape, count = shape_of(data), data.points.shape[1]
    left_out = np.unique(np.linspace(0, count - 1, min(count, _MARKERS_LEFT_OUT)).round().astype(int))
    frames = np.concatenate([[skin.first], judged])
    total, coordinates = np.zeros(len(FORMS)), 0
    for marker in left_out:
        rest = np.delete(np.arange(count), marker)
        fit = fit_rigid(shape[rest], data.points[frames][:, rest], sd[rest])
        place = np.einsum("fji,fj->fi", fit.rotation, data.points[frames, marker] - fit.translation)
        moved = place - shape[marker]
        known = np.isfinite(moved).all(-1)
        if known.sum() < 4 or not known[0]:
            continue
        part = replace(skin, courses=np.zeros((0, 0)), time=skin.time[frames][known], turn=skin.turn[frames][known])
        courses = _courses(_displacements(fit)[known], _MOST_MODES)
        total += [_left_out_likelihood(form, part, courses, moved[known]) for form in FORMS]
        coordinates += 3 * (int(known.sum()) - 1)
    return total / coordinates if coordinates else np.full(len(FORMS), np.nan)


def _left_out_likelihood(form: SkinForm, part: SkinMotion, courses: Floats, moved: Floats) -> float:
    """Give the log likelihood of a marker's displacements (n, 3) since the first of n frames, its own size profiled."""
    courses = courses[:, : form.rank]
    scales = _scales(part.turn, courses, 0)
    half = mixed(form, part.time, part.turn, courses, part.time, part.turn, courses, scales)
    covariance = half[1:, :1] + half[:1, 1:] - half[1:, 1:]
    covariance[np.diag_indices(len(covariance))] += 1e-6 * np.trace(covariance) / len(covariance)
    lower = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(lower, moved[1:] - moved[0])
    variance = (whitened**2).mean()
    return float(-3 * (len(lower) / 2 * np.log(max(variance, 1e-30)) + np.log(np.diag(lower)).sum()))


def _scales(turn: Floats, courses: Floats, first: int) -> tuple[float, float]:
    """Give the means of |turn| and of squared courses since the first posture, by which their shares are measured."""
    turned = float(np.abs(turn - turn[first]).mean())
    moved = float(((courses - courses[first]) ** 2).sum(-1).mean())
    return max(turned, _LEAST_TURN), max(moved, _LEAST_COURSE**2)
