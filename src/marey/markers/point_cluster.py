"""The point cluster technique: a cluster's centre of mass and principal axes as the frame that rides on the bone."""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.geometry import rotations
from marey.markers.bone_motion import BoneMotion, side_by_side
from marey.markers.cluster_data import ClusterData, cluster_data, counted
from marey.markers.mass_redistribution import redistributed
from marey.markers.problem import MarkerProblem
from marey.markers.rigid_fit import RigidFit, fit_rigid, gap_notes, one_bone

_LOOSE_AXES = np.radians(10)  # principal axes with a larger standard deviation than this do not name an orientation


@dataclass(frozen=True, eq=False, kw_only=True)
class ClusterSystem:
    """The cluster's own coordinate system in F frames ([Alexander2003] eq. (2))."""

    centre: Floats
    """(F, 3) C, the centre of mass [m]."""
    axes: Floats
    """(F, 3, 3) E, its columns the principal axes of inertia; a proper rotation."""
    moments: Floats
    """(F, 3) the second moments along these axes, sum of mass times distance squared [m2]; the inertia about an axis
    is the sum of the two others."""


def cluster_system(points: Floats, mass: Floats, near: Floats) -> ClusterSystem:
    """Give the centre of mass and the principal axes of points with masses.

    Which axis is which, and which way it points, eigenvalues do not tell, and their order may change from frame to
    frame: each axis is the one that lies nearest to where it is expected.

    Args:
        points: (F, M, 3) [m]; NaN where missing.
        mass: (F, M) 0 where missing.
        near: (F, 3, 3) where the axes are expected.
    """
    held = np.where(mass[..., None] > 0, points, 0.0)
    centre = np.einsum("fm,fmi->fi", mass, held) / mass.sum(1)[:, None]
    about = held - centre[:, None]
    moments, vectors = np.linalg.eigh(np.einsum("fm,fmi,fmj->fij", mass, about, about))
    order, sign = _matched(np.swapaxes(near, 1, 2) @ vectors)
    return ClusterSystem(
        centre=centre, axes=np.take_along_axis(vectors, order[:, None, :], 2) * sign[:, None, :],
        moments=np.take_along_axis(moments, order, 1),
    )  # fmt: skip


def _matched(cosines: Floats) -> tuple[Integers, Floats]:
    """Give each expected axis its eigenvector (F, 3) and sign (F, 3) from their cosines (F, expected, found)."""
    orders = np.array(list(permutations(range(3))))
    likeness = np.abs(cosines)[:, np.arange(3), orders].sum(-1)
    order = orders[likeness.argmax(1)]
    chosen = np.take_along_axis(cosines, order[:, :, None], 2)[..., 0]
    sign = np.where(chosen < 0, -1.0, 1.0)
    picked = np.take_along_axis(cosines, order[:, None, :], 2) * sign[:, None, :]
    mirrored = np.flatnonzero(np.linalg.det(picked) < 0)
    sign[mirrored, np.abs(chosen[mirrored]).argmin(1)] *= -1
    return order, sign


def point_cluster(problem: MarkerProblem) -> BoneMotion:
    """Move every bone with its cluster's centre of mass and principal axes, unit masses ([Andriacchi1998])."""
    return side_by_side([_bone(cluster_data(problem, c), problem.noise_m, masses=False) for c in problem.clusters])


def point_cluster_masses(problem: MarkerProblem) -> BoneMotion:
    """Do the same with masses chosen in each frame so that the eigenvalues of inertia stay as in the reference."""
    return side_by_side([_bone(cluster_data(problem, c), problem.noise_m, masses=True) for c in problem.clusters])


def _bone(data: ClusterData, noise_m: float, *, masses: bool) -> BoneMotion:
    fit = fit_rigid(data.reference, data.points, noise_m)
    answered = ~fit.few & ~fit.collinear
    mass = np.where(data.present & answered[:, None], 1.0, 0.0)
    mass[~answered] = 1.0  # any mass; the frame is emptied below
    reference = np.broadcast_to(data.reference, data.points.shape)
    at_rest = cluster_system(reference, mass, np.broadcast_to(np.eye(3), fit.rotation.shape))
    near = np.where(answered[:, None, None], fit.rotation, np.eye(3)) @ at_rest.axes
    points = np.where(answered[:, None, None], data.points, reference)
    notes = list(data.notes)
    if masses:
        mass, kept = redistributed(points, mass, at_rest.moments)
        notes += counted(data.segment, answered & ~kept, "keep unit masses: no masses above 0 keep the eigenvalues")
    system = cluster_system(points, mass, near)
    rotation = system.axes @ np.swapaxes(at_rest.axes, 1, 2)  # [Alexander2003] eq. (5a): O = E E_cb^-1
    origin = system.centre - np.einsum("fij,fj->fi", rotation, at_rest.centre)  # P = C - O C_cb
    covariance = _covariance(points, mass, system, at_rest, noise_m)
    covariance *= np.fmax(fit.variance_ratio, 1.0)[:, None, None]
    loose = answered & ~(np.sqrt(np.linalg.eigvalsh(covariance[:, :3, :3])[:, 2]) < _LOOSE_AXES)
    notes += _gaps(data.segment, fit, loose)
    rotation[~answered | loose], origin[~answered | loose] = np.nan, np.nan
    covariance[~answered | loose] = np.nan
    return one_bone(data.segment, rotation, origin, covariance, tuple(notes))


def _gaps(segment: str, fit: RigidFit, loose: Mask) -> tuple[str, ...]:
    return (
        *gap_notes(segment, fit),
        *counted(segment, loose, "have moments of inertia too nearly equal to tell the axes apart, and no answer"),
    )


def _covariance(points: Floats, mass: Floats, system: ClusterSystem, at_rest: ClusterSystem, noise_m: float) -> Floats:
    """Give the covariance (F, 6, 6) of the bones' poses to first order from the markers' noise.

    A displacement n of a marker at d in the cluster's axes turns the axes a and b into each other by
    mass (d_a n_b + d_b n_a) / (moment_a - moment_b): near-equal moments leave the axes loose.
    """
    total = mass.sum(1)[:, None, None]
    local = np.where(mass[..., None] > 0, points - system.centre[:, None], 0.0) @ system.axes
    jacobian = np.zeros((*local.shape[:2], 6, 3))  # of turn and centre in the cluster's axes
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        gap = (system.moments[:, a] - system.moments[:, b])[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            jacobian[..., c, b] = mass * local[..., a] / gap
            jacobian[..., c, a] = mass * local[..., b] / gap
        jacobian[..., 3 + c, c] = mass / total[..., 0]
    own = noise_m**2 * np.nan_to_num(np.einsum("fmai,fmbi->fab", jacobian, jacobian), nan=1e6, posinf=1e6)
    to_bone = np.zeros_like(own)
    rotation = system.axes @ np.swapaxes(at_rest.axes, 1, 2)
    to_bone[:, :3, :3] = at_rest.axes
    to_bone[:, 3:, :3] = rotation @ rotations.hat(at_rest.centre) @ at_rest.axes
    to_bone[:, 3:, 3:] = system.axes
    return np.asarray(to_bone @ own @ np.swapaxes(to_bone, 1, 2))
