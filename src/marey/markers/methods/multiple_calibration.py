"""Multiple calibration: the markers' places on the bone, known in several postures, follow the joint's turn."""

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.markers.data.bone_motion import BoneMotion, side_by_side
from marey.markers.data.cluster_data import ClusterData, cluster_data, counted
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import fit_rigid, gap_notes, one_bone, rigid_bone
from marey.markers.methods.joint_turn import JointTurn, segment_turn

_ROUNDS = 50
_STILL = 1e-12  # rad; a joint that turns by less from one round to the next has settled


def multiple_calibration(problem: MarkerProblem) -> BoneMotion:
    """Fit to every frame the shape interpolated between the known postures ([Cappello1997]).

    Unlike the paper, which interpolates in time between the first and the last posture of an exercise, the joint's
    turn interpolates: first as the mean shape gives it, then from the bones just found, until it settles. Beyond the
    postures the nearest one holds.

    Raises:
        MareyError: The calibration knows one posture only.
    """
    if problem.calibration.postures < 2:
        raise MareyError("Multiple calibration needs an anatomical calibration in at least two postures.")
    clusters = {data.segment: data for data in (cluster_data(problem, cluster) for cluster in problem.clusters)}
    motion = side_by_side([rigid_bone(data, problem.noise_m) for data in clusters.values()])
    turns = _turns(problem, motion)
    for _ in range(_ROUNDS):
        motion = side_by_side([_bone(data, turns[name], problem.noise_m) for name, data in clusters.items()])
        before, turns = turns, _turns(problem, motion)
        if _largest_change(before, turns) < _STILL:
            return motion
    return motion


def places_at(turn: Floats, at_postures: Floats, postures: Floats) -> Floats:
    """Interpolate the markers' places between the postures by a turn; beyond them the nearest posture holds.

    Args:
        turn: (F,) [rad].
        at_postures: (K,) the turn in each posture [rad].
        postures: (K, M, 3) the places [m]; a marker missing in a posture is interpolated between the others.

    Returns:
        (F, M, 3) [m]; NaN where the turn is.
    """
    order = np.argsort(at_postures)
    turn_there, postures = np.asarray(at_postures)[order], postures[order]
    places = np.full((len(turn), *postures.shape[1:]), np.nan)
    for marker in range(postures.shape[1]):
        known = np.isfinite(postures[:, marker]).all(-1)
        for axis in range(3):
            places[:, marker, axis] = np.interp(turn, turn_there[known], postures[known, marker, axis])
    places[~np.isfinite(turn)] = np.nan
    return places


def _bone(data: ClusterData, turn: JointTurn | None, noise_m: float) -> BoneMotion:
    if turn is None or turn.between_postures == 0:
        note = f"{data.segment}: the known postures hardly differ in its joints; fitted by their mean shape."
        plain = rigid_bone(data, noise_m)
        return one_bone(
            data.segment, plain.rotation[:, 0], plain.origin[:, 0], plain.covariance[:, 0], (*plain.notes, note)
        )
    places = places_at(turn.turn, turn.at_postures, data.postures)
    unknown = ~np.isfinite(turn.turn)
    places[unknown] = data.reference
    fit = fit_rigid(places, data.points, noise_m * np.sqrt(2))
    notes = (
        *data.notes,
        *counted(data.segment, unknown & ~fit.few, "are fitted by the mean shape: the joint's turn is not known there"),
        *gap_notes(data.segment, fit),
    )
    return one_bone(data.segment, fit.rotation, fit.translation, fit.covariance, notes)


def _turns(problem: MarkerProblem, motion: BoneMotion) -> dict[str, JointTurn | None]:
    return {cluster.segment: segment_turn(problem, motion, cluster.segment) for cluster in problem.clusters}


def _largest_change(before: dict[str, JointTurn | None], after: dict[str, JointTurn | None]) -> float:
    change = 0.0
    for first, second in zip(before.values(), after.values(), strict=True):
        if first is not None and second is not None:
            change = max(change, float(np.nan_to_num(np.abs(first.turn - second.turn)).max(initial=0.0)))
    return change
