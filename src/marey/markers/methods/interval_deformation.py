"""Interval deformation: markers' paths on the bone in a functional form, estimated together with its motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import SettingProblem
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, combine_bones
from marey.markers.data.cluster_data import ClusterData, cluster_data, frame_count_note
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import one_bone, rigid_bone
from marey.markers.data.setup import SkinChoice
from marey.markers.methods import skin_forms
from marey.markers.methods.interval_solver import SkinFit, SkinProblem, pose_covariance, solve
from marey.markers.methods.joint_turn import segment_turn
from marey.markers.methods.skin_forms import SkinForm

_INITIAL_SPREAD_M = 0.01
"""Initial standard deviation of skin displacements [m]; it is estimated from the data afterwards."""
_UNOBSERVED_RATIO = 0.5
"""A common motion whose standard deviation stays above this ratio to its prior counts as unobserved. Chosen by hand."""
_SPLINE_PIECES = 4
"""Pieces of a spline where the user specifies none. Chosen by hand."""
_MAXIMUM_FRAMES = 300
"""Frames from which the coefficients are estimated in a longer trial. Chosen by hand."""
_CONVERGED_RATIO = 0.1
"""A larger last change of a coefficient, as a ratio to the noise, is reported as not converged. Chosen by hand."""
_COLLINEAR_RATIO = 1e-3
"""Markers without skin motion whose distance from one line is below this ratio to the cluster's size do not determine
the rotation about it; numerical."""
_AXES = (
    "translation along x", "translation along y", "translation along z", "rotation about x", "rotation about y",
    "rotation about z",
)  # fmt: skip
"""Names of the rigid motions common to all markers, about the bone's axes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class IntervalDeformation:
    """One cluster's deformation and its bone's motion."""

    form: SkinForm
    """The functions of time that the markers may follow."""
    problem: SkinProblem
    """The cluster, the scaled functions, and the functions that each marker follows."""
    fit: SkinFit
    criterion: float
    """Bayesian information criterion; the smallest one indicates the best form."""

    @property
    def places(self) -> Floats:
        """(F, M, 3) the markers' positions on the bone, R(i, n) of [Alexander2003] eq. (3) [m]."""
        return self.fit.places(self.problem.functions)

    @property
    def unobserved(self) -> tuple[str, ...]:
        """The motions common to all markers that the data cannot distinguish from the bone's."""
        return tuple(name for name, share in self.unobserved_ratios.items() if share > _UNOBSERVED_RATIO)

    @property
    def unobserved_ratios(self) -> dict[str, float]:
        """Ratio of posterior to prior standard deviation of each common motion, the largest of all functions."""
        shares: dict[str, float] = {}
        for q in range(self.problem.moving.shape[1]):
            for name, pattern in _common_motions(self.problem.data.reference, self.problem.moving[:, q]):
                whole = np.zeros((*pattern.shape, self.problem.functions.shape[1]))
                whole[..., 1 + q] = pattern
                flat = whole.ravel() / np.linalg.norm(whole)
                share = float(np.sqrt(flat @ self.fit.covariance @ flat) / self.fit.spread[q])
                shares[name] = max(share, shares.get(name, 0.0))
        return shares


def _common_motions(places: Floats, moving: Mask) -> list[tuple[str, Floats]]:
    """Return the rigid motions of all markers that do not move the static ones: name and displacements (M, 3)."""
    about = places - places.mean(0)
    six = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), rotations.hat(about)], 1)
    if moving.all():
        return [(name, six[:, axis]) for axis, name in enumerate(_AXES)]
    if not moving.any():
        return []
    still = np.swapaxes(six[~moving], 1, 2).reshape(-1, 6)
    _, size, rows = np.linalg.svd(still / np.array([1, 1, 1, *[np.abs(about).max()] * 3]), full_matrices=True)
    free = rows[(size > _COLLINEAR_RATIO).sum() :] / np.array([1, 1, 1, *[np.abs(about).max()] * 3])
    return [("rotation about the static markers", np.einsum("a,mai->mi", row, six)) for row in free]


def deform(
    data: ClusterData,
    form: SkinForm,
    noise_m: float,
    *,
    moving: Mask | None = None,
    most_frames: int | None = _MAXIMUM_FRAMES,
) -> IntervalDeformation:
    """Estimate one cluster's deformation in one form together with its bone's motion.

    Args:
        data: The cluster.
        form: Functions of time that its markers may follow.
        noise_m: Standard deviation of a measured coordinate [m].
        moving: (M, Q) True where a marker follows a function; all by default.
        most_frames: In a longer trial, the paths are estimated from this number of evenly spaced frames; None for all.

    Returns:
        The deformation and the motion.
    """
    start = rigid_bone(data, noise_m)
    moving = np.ones((len(data.labels), form.count), bool) if moving is None else np.asarray(moving, bool)
    functions = np.concatenate([np.ones((len(data.points), 1)), form.functions - form.functions[data.frames[0]]], 1)
    problem = SkinProblem(data=data, answered=start.answered[:, 0], functions=functions, moving=moving, noise_m=noise_m)
    fit = solve(problem, start.rotation[:, 0], start.origin[:, 0], _INITIAL_SPREAD_M, most_frames)
    return IntervalDeformation(form=form, problem=problem, fit=fit, criterion=criterion(fit, moving, 1.0))


def criterion(fit: SkinFit, moving: Mask, memory: float) -> float:
    """Compute the Bayesian information criterion of a form.

    The residual variance is unknown but at least that of the noise. Six motions common to all markers count as the
    bone's and not as parameters of a function. The known postures have full weight.

    Args:
        fit: The fit of the form.
        moving: (M, Q) True where a marker follows a function.
        memory: Number of consecutive frames that carry the information of one.

    Returns:
        The criterion; smaller is better.
    """
    count = max(fit.free / memory, 2.0)
    variance = max(fit.squares / fit.free, 1e-12)
    parameters = 3.0 * moving.sum() - 6.0 * moving.all(0).sum()
    misfit = count * (np.log(variance) + 1) if variance > 1 else count * variance
    return float(misfit + fit.known_squares / max(variance, 1.0) + parameters * np.log(count))


def choose_form(
    data: ClusterData, forms: Sequence[SkinForm], noise_m: float, *, still: Sequence[str] = ()
) -> IntervalDeformation:
    """Estimate every form and return the one with the smallest information criterion.

    All forms are compared with the correlation length of the richest form's residuals, so that slowly varying misfit
    does not count once per frame.

    Args:
        data: The cluster.
        forms: Candidate forms.
        noise_m: Standard deviation of a measured coordinate [m].
        still: Labels of markers that do not move over the bone.

    Returns:
        The best deformation.
    """
    moves = np.array([label not in still for label in data.labels])
    tried = [deform(data, form, noise_m, moving=np.repeat(moves[:, None], form.count, 1)) for form in forms]
    memory = float(max(tried, key=lambda one: one.form.count).fit.memory)
    judged = [replace(one, criterion=criterion(one.fit, one.problem.moving, memory)) for one in tried]
    return min(judged, key=lambda one: one.criterion)


def chosen_form(problem: MarkerProblem, choice: SkinChoice, segment: str, motion: BoneMotion) -> SkinForm:
    """Create the form that the user specified for a segment.

    Raises:
        SettingProblem: The trial does not meet the requirements of the form.
    """
    time = problem.trajectories.time
    turn = segment_turn(problem, motion, segment)
    turned = None if turn is None or not np.isfinite(turn.turn).any() else turn.turn
    if choice.functions is not None:
        values = choice.functions
        return skin_forms.custom("as in the given file", lambda _: values, time)
    if choice.form == "rotation":
        if turned is None:
            raise SettingProblem(
                f"Skin of {segment} linear in the joint's rotation: none of its joints rotates in this trial."
            )
        return skin_forms.linear_in_turn(turned)
    if choice.form == "sinusoid":
        rate = problem.trajectories.rate
        period = choice.period_s or (None if turned is None else skin_forms.period_of(turned[:, None], rate))
        if period is None:
            raise SettingProblem(f"Skin of {segment} as a sinusoid: the motion is not periodic. Specify period_s.")
        return skin_forms.sinusoid(time, period)
    if choice.form == "spline":
        return skin_forms.spline(time, choice.pieces or _SPLINE_PIECES)
    return skin_forms.linear_in_time(time) if choice.form == "time" else skin_forms.constant(len(time))


def candidate_forms(problem: MarkerProblem, segment: str, motion: BoneMotion) -> tuple[SkinForm, ...]:
    """Return the candidate forms of a segment: constant, linear in time or rotation, sinusoid, spline.

    Motion common to all markers is observed in the known postures only. With several postures, only forms that transfer
    it to the other frames are candidates: constant, and linear in the joint's rotation.
    """
    time = problem.trajectories.time
    forms = [skin_forms.constant(len(time))]
    turn = segment_turn(problem, motion, segment)
    if turn is not None and not np.isfinite(turn.turn).any():
        turn = None
    if turn is not None:
        forms.append(skin_forms.linear_in_turn(turn.turn))
    if problem.calibration.postures > 1:
        return tuple(forms)
    forms.append(skin_forms.linear_in_time(time))
    if turn is not None:
        period = skin_forms.period_of(turn.turn[:, None], problem.trajectories.rate)
        if period is not None:
            forms.append(skin_forms.sinusoid(time, period))
    if len(time) > 4 * _SPLINE_PIECES:
        forms.append(skin_forms.spline(time, _SPLINE_PIECES))
    return tuple(forms)


def interval(problem: MarkerProblem) -> BoneMotion:
    """Estimate every bone by interval deformation ([Alexander2001]).

    The form is the one that the problem specifies for the segment; otherwise the information criterion chooses it.
    """
    clusters = [cluster_data(problem, cluster) for cluster in problem.clusters]
    plain = combine_bones([rigid_bone(data, problem.noise_m) for data in clusters])
    return combine_bones([_bone(problem, data, plain) for data in clusters])


def _bone(problem: MarkerProblem, data: ClusterData, plain: BoneMotion) -> BoneMotion:
    if not plain.answered[:, plain.segments.index(data.segment)].any():
        return rigid_bone(data, problem.noise_m)
    choice = problem.skin.get(data.segment)
    if choice is None:
        return bone_motion_of(choose_form(data, candidate_forms(problem, data.segment, plain), problem.noise_m))
    unknown = [label for label in choice.still if label not in data.labels]
    if unknown:
        raise SettingProblem(
            f"Markers of {data.segment} listed in `still` are missing from the trial: {', '.join(unknown)}."
        )
    form = chosen_form(problem, choice, data.segment, plain)
    return bone_motion_of(choose_form(data, [form], problem.noise_m, still=choice.still))


def bone_motion_of(deformation: IntervalDeformation) -> BoneMotion:
    """Return the bone's motion of a deformation, with notes."""
    fit, data = deformation.fit, deformation.problem.data
    empty, segment = ~deformation.problem.answered, data.segment
    covariance = pose_covariance(deformation.problem, fit)
    rotation, origin = fit.rotation.copy(), fit.origin.copy()
    rotation[empty], origin[empty], covariance[empty] = np.nan, np.nan, np.nan
    notes = [*data.notes, f"{segment}: form of the skin motion: {deformation.form.name}."]
    notes += frame_count_note(segment, empty, "have too few markers, or collinear ones, and no result")
    if fit.last_change > _CONVERGED_RATIO * deformation.problem.noise_m:
        change = 1000 * fit.last_change
        notes.append(f"{segment}: markers' paths have not converged; the last step changed them by {change:.2f} mm.")
    if deformation.unobserved:
        notes.append(
            f"{segment}: motions common to all markers that are not observed and count as the bone's: "
            f"{', '.join(deformation.unobserved)}."
        )
    return one_bone(segment, rotation, origin, covariance, tuple(notes))
