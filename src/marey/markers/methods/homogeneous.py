"""Homogeneous factorisation: each cluster as a few basis shapes in rigid motion."""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, combine_bones
from marey.markers.data.cluster_data import ClusterData, cluster_data
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import fit_rigid, gap_notes, one_bone, rigid_bone
from marey.nonrigid.in_space.factorisation import HomogeneousShapes, factorise_points

_MAXIMUM_SHAPES = 3
"""Most basis shapes of a cluster. On made clusters after table 3 of [Alexander2003] the error falls up to three
(docs/accuracy/markers.md)."""


def homogeneous(problem: MarkerProblem) -> BoneMotion:
    """Estimate every bone by the rigid part of its cluster's low-rank factorisation ([Alexander2003] eq. (15)-(21)).

    The pose of the bone relative to the shapes comes from the known posture, or from the mean over several postures.
    There are three basis shapes, or as many as markers and frames allow. Rigid motion common to all markers counts as
    motion of the bone.
    """
    return combine_bones([bone_by_factorisation(cluster_data(problem, c), problem.noise_m) for c in problem.clusters])


def bone_by_factorisation(data: ClusterData, noise_m: float, rank: int | None = None) -> BoneMotion:
    """Estimate one bone by a factorisation of its cluster into `rank` basis shapes; None chooses their number."""
    enough = fit_rigid(data.reference, data.points, noise_m)
    answered = ~enough.few & ~enough.collinear
    notes = (*data.notes, *gap_notes(data.segment, enough))
    if answered.sum() < 2:
        return rigid_bone(data, noise_m)  # one frame has one shape
    if not answered[data.frames].any():
        why = f"{data.segment}: too few markers in the known postures to locate the bone; no result."
        return one_bone(data.segment, *_empty(len(data.points)), (*notes, why))
    rank = rank or min(_MAXIMUM_SHAPES, int(answered.sum()) - 1, max(len(data.labels) - 3, 1))
    points = np.where(answered[:, None, None], data.points, np.nan)
    shapes = factorise_points(points, max(rank, 1))
    turn, place = _bone_in_object(data, shapes)
    rotation = shapes.rotation @ turn
    origin = shapes.translation + np.einsum("fij,j->fi", shapes.rotation, place)
    covariance = _covariance(shapes, turn, place)
    return one_bone(
        data.segment, rotation, origin, covariance, (*notes, f"{data.segment}: basis shapes: {shapes.rank}.")
    )


def _bone_in_object(data: ClusterData, shapes: HomogeneousShapes) -> tuple[Floats, Floats]:
    """Return the bone's rotation (3, 3) and origin (3,) [m] in the object's frame: the mean over the known postures."""
    known = np.isfinite(shapes.rotation[data.frames]).all((1, 2))
    to_object = np.swapaxes(shapes.rotation[data.frames][known], 1, 2)
    turn = rotations.mean(to_object @ data.rotation[known])
    offset = data.origin[known] - shapes.translation[data.frames][known]
    return turn, np.einsum("kij,kj->ki", to_object, offset).mean(0)


def _covariance(shapes: HomogeneousShapes, turn: Floats, place: Floats) -> Floats:
    """Propagate the covariance of the object's poses to the bone, which is fixed to it."""
    jacobian = np.zeros((len(shapes.rotation), 6, 6))
    jacobian[:, :3, :3] = turn.T
    jacobian[:, 3:, :3] = -shapes.rotation @ rotations.hat(place)
    jacobian[:, 3:, 3:] = np.eye(3)
    return np.asarray(jacobian @ shapes.covariance @ np.swapaxes(jacobian, 1, 2))


def _empty(count: int) -> tuple[Floats, Floats, Floats]:
    return np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan), np.full((count, 6, 6), np.nan)
