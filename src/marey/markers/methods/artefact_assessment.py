"""Artefact assessment: skin motion learned from an exercise as a function of a joint's rotation, then removed."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.markers.data.bone_motion import BoneMotion, combine_bones
from marey.markers.data.cluster_data import ClusterData, cluster_data
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import fit_rigid, one_bone, rigid_bone
from marey.markers.methods.joint_turn import JointAxis, joint_axis, segment_axis, turn_about
from marey.markers.preprocessing.preparation import prepare_problem

_LOCKED_BELOW = np.radians(15)
"""A joint that rotates less than this in the exercise [rad] counts as held still. Chosen by hand."""
_FEWEST_POSTURES = 4
"""Fewest known postures that determine a polynomial of the third degree."""
_DEGREE = 3
"""Degree of the polynomial of a marker's position in the joint's rotation. Chosen by hand."""
_MAXIMUM_ROUNDS = 50
"""Most rounds of fit and removal. Chosen by hand."""
_CONVERGED = 1e-10
"""The iteration ends when no origin changes by more than this [m]; numerical."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Artefact:
    """The motion of one segment's markers over the bone as a function of a joint's rotation."""

    segment: str
    axis: JointAxis
    """The joint's axis, with the zero of the exercise."""
    range: tuple[float, float]
    """Range of the rotation in the exercise [rad]; beyond it the nearest end is used."""
    coefficients: dict[str, Floats]
    """For each label (D + 1, 3) Legendre coefficients of the marker's position over the range, mapped to -1..1 [m]."""

    def places(self, label: str, turn: Floats) -> Floats:
        """Return the marker's positions (F, 3) [m] in the exercise at rotations (F,) [rad]."""
        low, high = self.range
        along = 2 * (np.clip(turn, low, high) - low) / (high - low) - 1
        coefficients = self.coefficients[label]
        return np.asarray(np.polynomial.legendre.legvander(along, len(coefficients) - 1) @ coefficients)


def artefact_assessment(problem: MarkerProblem) -> BoneMotion:
    """Remove in every frame the skin motion that an exercise shows at the same rotation of the joint ([Lucchetti1998]).

    The rotation comes first from the rigid fit, then from the current bones, until convergence. A segment without
    information in the exercise is fitted rigidly, with a note.

    Raises:
        MareyError: There is no exercise, or it does not determine the skin motion of any segment.
    """
    if problem.exercise is None:
        raise MareyError("Artefact assessment needs a trial of an exercise with the same markers.")
    learned, notes = assess(problem.exercise)
    if not learned:
        raise MareyError("The exercise does not determine the skin motion of any segment. " + " ".join(notes))
    clusters = [cluster_data(problem, cluster) for cluster in problem.clusters]
    motion = combine_bones([rigid_bone(data, problem.noise_m) for data in clusters])
    before = np.zeros_like(motion.origin)
    for _ in range(_MAXIMUM_ROUNDS):
        motion = combine_bones([_bone(data, learned.get(data.segment), problem, motion) for data in clusters])
        if np.nan_to_num(np.abs(motion.origin - before)).max(initial=0.0) < _CONVERGED:
            break
        before = motion.origin
    return replace(motion, notes=(*motion.notes, *notes))


def assess(exercise: MarkerProblem) -> tuple[dict[str, Artefact], tuple[str, ...]]:
    """Learn from an exercise how each segment's markers move over the bone as its joint rotates.

    Either the bones of the exercise are known in four postures or more; or, as in the paper, a joint was held still
    while its neighbour moved: then the segment above it is assumed to move rigidly with the segment below it, whose
    skin moves less.

    Returns:
        The artefacts of the segments that the exercise determines, and one sentence about each other segment.
    """
    ready = prepare_problem(exercise)
    if ready.problem is None:
        return {}, ready.notes
    exercise = ready.problem
    clusters = [cluster_data(exercise, cluster) for cluster in exercise.clusters]
    plain = combine_bones([rigid_bone(data, exercise.noise_m) for data in clusters])
    many = exercise.calibration.postures >= _FEWEST_POSTURES
    locked = () if many else _locked(exercise, plain)
    learned, notes = {}, list(ready.notes)
    for data in clusters:
        bones = _known(exercise, plain) if many else _moved_by_segment_below(exercise, plain, locked, data.segment)
        axis = None if bones is None else segment_axis(exercise, bones, data.segment, locked=locked)
        if bones is None or axis is None:
            notes.append(f"{data.segment}: the exercise does not show its bone; fitted as a rigid cluster.")
        else:
            learned[data.segment] = _artefact(data, bones, axis)
    return learned, tuple(notes)


def _locked(exercise: MarkerProblem, plain: BoneMotion) -> tuple[tuple[str, str], ...]:
    """Find the joints that rotate too little in the exercise."""
    turns = [
        (pair, turn_about(joint_axis(exercise, plain, *pair), exercise, plain))
        for pair in exercise.joints
        if set(pair) <= set(plain.segments)
    ]
    return tuple(pair for pair, turn in turns if turn.range < _LOCKED_BELOW)


def _known(exercise: MarkerProblem, plain: BoneMotion) -> BoneMotion:
    """Return the bones in the known postures, NaN elsewhere."""
    rotation, origin = np.full_like(plain.rotation, np.nan), np.full_like(plain.origin, np.nan)
    calibration = exercise.calibration
    index = [calibration.segments.index(segment) for segment in plain.segments]
    rotation[calibration.frames] = calibration.rotation[:, index]
    origin[calibration.frames] = calibration.origin[:, index]
    return replace(plain, rotation=rotation, origin=origin)


def _moved_by_segment_below(
    exercise: MarkerProblem, plain: BoneMotion, locked: tuple[tuple[str, str], ...], segment: str
) -> BoneMotion | None:
    """Return the bones with the segment moved by the one below it; None if no joint below it was held still."""
    below = [child for parent, child in locked if parent == segment]
    if not below:
        return None
    calibration = exercise.calibration
    own, other = calibration.segments.index(segment), calibration.segments.index(below[0])
    base = calibration.rotation[0, other].T
    offset = base @ (calibration.origin[0, own] - calibration.origin[0, other])
    carrier = plain.bone(below[0])
    rotation, origin = plain.rotation.copy(), plain.origin.copy()
    index = plain.segments.index(segment)
    rotation[:, index] = carrier[0] @ base @ calibration.rotation[0, own]
    origin[:, index] = carrier[1] + np.einsum("fij,j->fi", carrier[0], offset)
    return replace(plain, rotation=rotation, origin=origin)


def _artefact(data: ClusterData, bones: BoneMotion, axis: JointAxis) -> Artefact:
    """Fit each marker's position on the bone as a polynomial in the rotation."""
    turn = axis.turn(bones.rotation, bones.segments)
    rotation, origin = bones.bone(data.segment)
    places = np.einsum("fji,fmj->fmi", rotation, data.points - origin[:, None])
    seen = np.isfinite(places).all(-1) & np.isfinite(turn)[:, None]
    low, high = float(np.nanmin(turn)), float(np.nanmax(turn))
    along = 2 * (turn - low) / max(high - low, np.finfo(float).tiny) - 1
    coefficients = {}
    for number, label in enumerate(data.labels):
        at = seen[:, number]
        if at.sum() < _FEWEST_POSTURES:
            continue
        degree = min(_DEGREE, int(at.sum()) - 2)
        design = np.polynomial.legendre.legvander(along[at], degree)
        coefficients[label] = np.linalg.lstsq(design, places[at, number], rcond=None)[0]
    return Artefact(segment=data.segment, axis=axis, range=(low, high), coefficients=coefficients)


def _bone(data: ClusterData, learned: Artefact | None, problem: MarkerProblem, motion: BoneMotion) -> BoneMotion:
    """Fit one cluster to its shape at each frame's rotation; only the change of shape comes from the exercise."""
    if learned is None or not _has_bones_of(motion, learned.axis):
        return rigid_bone(data, problem.noise_m)
    turn = learned.axis.turn(motion.rotation, motion.segments)
    calibration = problem.calibration
    at_postures = learned.axis.turn(calibration.rotation, calibration.segments)
    shift = np.zeros_like(data.points)
    reference = data.postures.copy()
    for number, label in enumerate(data.labels):
        if label in learned.coefficients:
            shift[:, number] = learned.places(label, turn)
            reference[:, number] -= learned.places(label, at_postures)
    fit = fit_rigid(np.nanmean(reference, 0) + shift, data.points, problem.noise_m * np.sqrt(2))
    notes = [*data.notes]
    beyond = np.isfinite(turn) & ((turn < learned.range[0]) | (turn > learned.range[1]))
    if beyond.any():
        notes.append(f"{data.segment}: {beyond.sum()} of {len(turn)} frames rotate beyond the range of the exercise.")
    return one_bone(data.segment, fit.rotation, fit.translation, fit.covariance, tuple(notes))


def _has_bones_of(motion: BoneMotion, axis: JointAxis) -> bool:
    return axis.child in motion.segments and (axis.parent is None or axis.parent in motion.segments)
