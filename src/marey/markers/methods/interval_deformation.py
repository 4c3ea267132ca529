"""Interval deformation: markers' paths on the bone of an assumed form, estimated together with the bone's motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import SettingProblem
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, side_by_side
from marey.markers.data.cluster_data import ClusterData, cluster_data, counted
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import one_bone, rigid_bone
from marey.markers.data.setup import SkinChoice
from marey.markers.methods import skin_forms
from marey.markers.methods.interval_solver import SkinFit, SkinProblem, pose_covariance, solve
from marey.markers.methods.joint_turn import segment_turn
from marey.markers.methods.skin_forms import SkinForm

_SPREAD_M = 0.01  # of skin displacements, to start from
_UNSEEN = 0.5  # of the spread; a common motion whose standard deviation stays above this is called unseen
_SPLINE_PIECES = 4
_MOST_FRAMES = 300
_SETTLED = 0.1  # of the noise
_LINE = 1e-3  # still markers nearer to one line than this share of the cluster's size leave the turn about it open
_AXES = ("shift along x", "shift along y", "shift along z", "turn about x", "turn about y", "turn about z")


@dataclass(frozen=True, eq=False, kw_only=True)
class Deformation:
    """One cluster's deformation and its bone's motion."""

    form: SkinForm
    """All functions of time that the markers may follow."""
    problem: SkinProblem
    """The cluster, the functions as they are used, and which marker follows which."""
    fit: SkinFit
    criterion: float
    """Bayesian information criterion; the least one is the best form."""

    @property
    def places(self) -> Floats:
        """(F, M, 3) the markers' places on the bone, R(i, n) of [Alexander2003] eq. (3) [m]."""
        return self.fit.places(self.problem.functions)

    @property
    def unseen(self) -> tuple[str, ...]:
        """The motions common to all markers that the data do not tell from the bone's, about the bone's axes."""
        return tuple(name for name, share in self.unseen_share.items() if share > _UNSEEN)

    @property
    def unseen_share(self) -> dict[str, float]:
        """What the data leave of each common motion's spread: 0 seen, 1 not seen at all; the most of any function."""
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
    """Give the motions of all markers as one rigid body that leave those in place which do not move: name, (M, 3)."""
    about = places - places.mean(0)
    six = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), rotations.hat(about)], 1)
    if moving.all():
        return [(name, six[:, axis]) for axis, name in enumerate(_AXES)]
    if not moving.any():
        return []
    still = np.swapaxes(six[~moving], 1, 2).reshape(-1, 6)
    _, size, rows = np.linalg.svd(still / np.array([1, 1, 1, *[np.abs(about).max()] * 3]), full_matrices=True)
    free = rows[(size > _LINE).sum() :] / np.array([1, 1, 1, *[np.abs(about).max()] * 3])
    return [("turn about the markers that stand still", np.einsum("a,mai->mi", row, six)) for row in free]


def deform(
    data: ClusterData,
    form: SkinForm,
    noise_m: float,
    *,
    moving: Mask | None = None,
    most_frames: int | None = _MOST_FRAMES,
) -> Deformation:
    """Estimate one cluster's deformation of one form together with its bone's motion.

    Args:
        data: The cluster.
        form: Functions of time that its markers may follow.
        noise_m: Standard deviation of a measured coordinate [m].
        moving: (M, Q) which marker follows which function; all by default.
        most_frames: Of a longer trial so many frames, evenly taken, give the markers' paths; None takes all.
    """
    start = rigid_bone(data, noise_m)
    moving = np.ones((len(data.labels), form.count), bool) if moving is None else np.asarray(moving, bool)
    functions = np.concatenate([np.ones((len(data.points), 1)), form.functions - form.functions[data.frames[0]]], 1)
    problem = SkinProblem(data=data, answered=start.answered[:, 0], functions=functions, moving=moving, noise_m=noise_m)
    fit = solve(problem, start.rotation[:, 0], start.origin[:, 0], _SPREAD_M, most_frames)
    return Deformation(form=form, problem=problem, fit=fit, criterion=criterion(fit, moving, 1.0))


def criterion(fit: SkinFit, moving: Mask, memory: float) -> float:
    """Give the Bayesian information criterion of a form, of frames that count once in so many.

    The variance about the form is unknown but at least that of the noise; of each function's displacements six
    motions common to all markers count as the bone's. The known postures count in full.
    """
    count = max(fit.free / memory, 2.0)
    variance = max(fit.squares / fit.free, 1e-12)
    parameters = 3.0 * moving.sum() - 6.0 * moving.all(0).sum()
    misfit = count * (np.log(variance) + 1) if variance > 1 else count * variance
    return float(misfit + fit.known_squares / max(variance, 1.0) + parameters * np.log(count))


def choose(data: ClusterData, forms: Sequence[SkinForm], noise_m: float, *, still: Sequence[str] = ()) -> Deformation:
    """Estimate every form and keep the one with the least information criterion.

    All are judged with the memory of the residuals that the richest form leaves, so that slow misfit is not counted
    once a frame.

    Args:
        data: The cluster.
        forms: To choose from.
        noise_m: Standard deviation of a measured coordinate [m].
        still: Markers that do not move over the bone, whatever the form.
    """
    moves = np.array([label not in still for label in data.labels])
    tried = [deform(data, form, noise_m, moving=np.repeat(moves[:, None], form.count, 1)) for form in forms]
    memory = float(max(tried, key=lambda one: one.form.count).fit.memory)
    judged = [replace(one, criterion=criterion(one.fit, one.problem.moving, memory)) for one in tried]
    return min(judged, key=lambda one: one.criterion)


def chosen_form(problem: MarkerProblem, choice: SkinChoice, segment: str, motion: BoneMotion) -> SkinForm:
    """Make the form that was chosen for a segment.

    Raises:
        SettingProblem: The trial does not have what the form needs.
    """
    time = problem.trajectories.time
    turn = segment_turn(problem, motion, segment)
    turned = None if turn is None or not np.isfinite(turn.turn).any() else turn.turn
    if choice.functions is not None:
        values = choice.functions
        return skin_forms.own("as the file says", lambda _: values, time)
    if choice.form == "turn":
        if turned is None:
            raise SettingProblem(f"Skin of {segment} linear in the joint's turn: no joint of it turns in this trial.")
        return skin_forms.linear_in_turn(turned)
    if choice.form == "sinusoid":
        rate = problem.trajectories.rate
        period = choice.period_s or (None if turned is None else skin_forms.period_of(turned[:, None], rate))
        if period is None:
            raise SettingProblem(f"Skin of {segment} as a sinusoid: the motion does not repeat; give period_s.")
        return skin_forms.sinusoid(time, period)
    if choice.form == "spline":
        return skin_forms.spline(time, choice.pieces or _SPLINE_PIECES)
    return skin_forms.linear_in_time(time) if choice.form == "time" else skin_forms.constant(len(time))


def forms_of(problem: MarkerProblem, segment: str, motion: BoneMotion) -> tuple[SkinForm, ...]:
    """Give the forms that a trial offers one segment: constant, linear in time or turn, sinusoid, spline.

    What all markers do together is seen in the known postures alone. With several, only the forms that carry it from
    there to the other frames are offered: constant, and linear in the joint's turn.
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
    """Move every bone by interval deformation ([Alexander2001]).

    The form is the one that the problem says for the segment; where it says none, the information criterion chooses.
    """
    clusters = [cluster_data(problem, cluster) for cluster in problem.clusters]
    plain = side_by_side([rigid_bone(data, problem.noise_m) for data in clusters])
    return side_by_side([_bone(problem, data, plain) for data in clusters])


def _bone(problem: MarkerProblem, data: ClusterData, plain: BoneMotion) -> BoneMotion:
    if not plain.answered[:, plain.segments.index(data.segment)].any():
        return rigid_bone(data, problem.noise_m)
    choice = problem.skin.get(data.segment)
    if choice is None:
        return motion_of(choose(data, forms_of(problem, data.segment, plain), problem.noise_m))
    unknown = [label for label in choice.still if label not in data.labels]
    if unknown:
        raise SettingProblem(f"Markers of {data.segment} said to stand still are not there: {', '.join(unknown)}.")
    form = chosen_form(problem, choice, data.segment, plain)
    return motion_of(choose(data, [form], problem.noise_m, still=choice.still))


def motion_of(deformation: Deformation) -> BoneMotion:
    """Give the bone's motion of a deformation, with what has to be said of it."""
    fit, data = deformation.fit, deformation.problem.data
    empty, segment = ~deformation.problem.answered, data.segment
    covariance = pose_covariance(deformation.problem, fit)
    rotation, origin = fit.rotation.copy(), fit.origin.copy()
    rotation[empty], origin[empty], covariance[empty] = np.nan, np.nan, np.nan
    notes = [*data.notes, f"{segment}: markers move {deformation.form.name}."]
    notes += counted(segment, empty, "have too few markers, or markers in a line, and no answer")
    if fit.last_change > _SETTLED * deformation.problem.noise_m:
        change = 1000 * fit.last_change
        notes.append(f"{segment}: markers' paths had not settled; the last round changed them by {change:.2f} mm.")
    if deformation.unseen:
        notes.append(
            f"{segment}: not seen, and taken for the bone's, is what all markers do together: "
            f"{', '.join(deformation.unseen)}."
        )
    return one_bone(segment, rotation, origin, covariance, tuple(notes))
