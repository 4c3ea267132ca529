"""Artefact assessment: skin motion learned from an exercise against a joint's turn, taken away in the activity."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.markers.data.bone_motion import BoneMotion, side_by_side
from marey.markers.data.cluster_data import ClusterData, cluster_data
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import fit_rigid, one_bone, rigid_bone
from marey.markers.methods.joint_turn import JointAxis, joint_axis, segment_axis, turn_about
from marey.markers.preprocessing.preparation import prepared

_LOCKED_BELOW = np.radians(15)  # a joint that turns less than this in the exercise was held still
_FEWEST_POSTURES = 4
_DEGREE = 3
_ROUNDS = 50
_STILL = 1e-10  # m


@dataclass(frozen=True, eq=False, kw_only=True)
class Artefact:
    """What the markers of one segment do on the bone as a joint turns."""

    segment: str
    axis: JointAxis
    """The joint's turn, counted as in the exercise."""
    range: tuple[float, float]
    """The turns that the exercise went through [rad]; beyond them the nearest one holds."""
    coefficients: dict[str, Floats]
    """For each label (D + 1, 3): the marker's place as a polynomial in the turn over the range, -1 to 1 [m]."""

    def places(self, label: str, turn: Floats) -> Floats:
        """(F, 3) where the exercise has the marker at turns (F,) [m]."""
        low, high = self.range
        along = 2 * (np.clip(turn, low, high) - low) / (high - low) - 1
        coefficients = self.coefficients[label]
        return np.asarray(np.polynomial.legendre.legvander(along, len(coefficients) - 1) @ coefficients)


def artefact_assessment(problem: MarkerProblem) -> BoneMotion:
    """Take away in every frame the skin motion that an exercise shows at the same turn of the joint ([Lucchetti1998]).

    The turn comes first from the rigid fit, then from the bones just found, until it settles. A segment of which the
    exercise tells nothing is fitted rigidly, and it is said.

    Raises:
        MareyError: There is no exercise, or it tells of no segment how its markers move over the bone.
    """
    if problem.exercise is None:
        raise MareyError("Artefact assessment needs a trial of an exercise with the same markers.")
    learned, notes = assess(problem.exercise)
    if not learned:
        raise MareyError("The exercise does not tell how markers move over any bone. " + " ".join(notes))
    clusters = [cluster_data(problem, cluster) for cluster in problem.clusters]
    motion = side_by_side([rigid_bone(data, problem.noise_m) for data in clusters])
    before = np.zeros_like(motion.origin)
    for _ in range(_ROUNDS):
        motion = side_by_side([_bone(data, learned.get(data.segment), problem, motion) for data in clusters])
        if np.nan_to_num(np.abs(motion.origin - before)).max(initial=0.0) < _STILL:
            break
        before = motion.origin
    return replace(motion, notes=(*motion.notes, *notes))


def assess(exercise: MarkerProblem) -> tuple[dict[str, Artefact], tuple[str, ...]]:
    """Learn from an exercise how each segment's markers move over the bone as its joint turns.

    The bones of the exercise are known in four postures or more; or, as in the paper, a joint was held still while its
    neighbour moved: then the segment above it goes where the one below it goes, whose skin moves less.

    Returns:
        The artefacts of the segments that the exercise tells of, and a sentence about each other segment.
    """
    ready = prepared(exercise)
    if ready.problem is None:
        return {}, ready.notes
    exercise = ready.problem
    clusters = [cluster_data(exercise, cluster) for cluster in exercise.clusters]
    plain = side_by_side([rigid_bone(data, exercise.noise_m) for data in clusters])
    many = exercise.calibration.postures >= _FEWEST_POSTURES
    locked = () if many else _locked(exercise, plain)
    learned, notes = {}, list(ready.notes)
    for data in clusters:
        bones = _known(exercise, plain) if many else _carried(exercise, plain, locked, data.segment)
        axis = None if bones is None else segment_axis(exercise, bones, data.segment, locked=locked)
        if bones is None or axis is None:
            notes.append(f"{data.segment}: the exercise does not show its bone; fitted as a rigid cluster.")
        else:
            learned[data.segment] = _artefact(data, bones, axis)
    return learned, tuple(notes)


def _locked(exercise: MarkerProblem, plain: BoneMotion) -> tuple[tuple[str, str], ...]:
    """Find the joints that hardly turn in the exercise."""
    turns = [
        (pair, turn_about(joint_axis(exercise, plain, *pair), exercise, plain))
        for pair in exercise.joints
        if set(pair) <= set(plain.segments)
    ]
    return tuple(pair for pair, turn in turns if turn.range < _LOCKED_BELOW)


def _known(exercise: MarkerProblem, plain: BoneMotion) -> BoneMotion:
    """Give the bones in the known postures only, NaN elsewhere."""
    rotation, origin = np.full_like(plain.rotation, np.nan), np.full_like(plain.origin, np.nan)
    calibration = exercise.calibration
    index = [calibration.segments.index(segment) for segment in plain.segments]
    rotation[calibration.frames] = calibration.rotation[:, index]
    origin[calibration.frames] = calibration.origin[:, index]
    return replace(plain, rotation=rotation, origin=origin)


def _carried(
    exercise: MarkerProblem, plain: BoneMotion, locked: tuple[tuple[str, str], ...], segment: str
) -> BoneMotion | None:
    """Give the bones with the segment carried by the one below it; None where no joint below it was held still."""
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
    """Fit each marker's place on the bone as a polynomial in the turn."""
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
    """Fit one cluster to its shape at each frame's turn; only what the turn changes is taken from the exercise."""
    if learned is None or not _known_to(motion, learned.axis):
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
        notes.append(f"{data.segment}: {beyond.sum()} of {len(turn)} frames turn farther than the exercise did.")
    return one_bone(data.segment, fit.rotation, fit.translation, fit.covariance, tuple(notes))


def _known_to(motion: BoneMotion, axis: JointAxis) -> bool:
    return axis.child in motion.segments and (axis.parent is None or axis.parent in motion.segments)
