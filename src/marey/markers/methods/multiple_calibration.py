"""Multiple calibration: marker positions on the bone, known in several postures, follow the joint's rotation."""

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.markers.data.bone_motion import BoneMotion, combine_bones
from marey.markers.data.cluster_data import ClusterData, cluster_data, frame_count_note
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import fit_rigid, gap_notes, one_bone, rigid_bone
from marey.markers.methods.joint_turn import JointTurn, segment_turn

_MAXIMUM_ROUNDS = 50
"""Most rounds of fit and interpolation. Chosen by hand."""
_CONVERGED = 1e-12
"""The iteration ends when no joint rotation changes by more than this [rad]; numerical."""


def multiple_calibration(problem: MarkerProblem) -> BoneMotion:
    """Fit to every frame the shape interpolated between the known postures ([Cappello1997]).

    Unlike the paper, which interpolates in time between the first and the last posture of an exercise, the shape is
    interpolated by the joint's rotation: first that of the rigid fit, then that of the current bones, until
    convergence. Beyond the postures the nearest one is used.

    Raises:
        MareyError: The calibration contains one posture only.
    """
    if problem.calibration.postures < 2:
        raise MareyError("Multiple calibration needs an anatomical calibration in at least two postures.")
    clusters = {data.segment: data for data in (cluster_data(problem, cluster) for cluster in problem.clusters)}
    motion = combine_bones([rigid_bone(data, problem.noise_m) for data in clusters.values()])
    turns = _turns(problem, motion)
    for _ in range(_MAXIMUM_ROUNDS):
        motion = combine_bones([_bone(data, turns[name], problem.noise_m) for name, data in clusters.items()])
        before, turns = turns, _turns(problem, motion)
        if _largest_change(before, turns) < _CONVERGED:
            return motion
    return motion


def places_at(turn: Floats, at_postures: Floats, postures: Floats) -> Floats:
    """Interpolate marker positions between the postures by a joint's rotation; beyond them the nearest posture is used.

    Args:
        turn: (F,) the joint's rotation [rad].
        at_postures: (K,) the rotation in each posture [rad].
        postures: (K, M, 3) the positions [m]; a marker missing in a posture is interpolated between the others.

    Returns:
        (F, M, 3) [m]; NaN where the rotation is NaN.
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
        note = f"{data.segment}: the known postures differ too little in its joints; the mean shape is fitted."
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
        *frame_count_note(
            data.segment, unknown & ~fit.few, "are fitted by the mean shape: the joint's rotation is not known there"
        ),
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
