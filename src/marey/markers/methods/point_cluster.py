"""The point cluster technique: centre of mass and principal axes of a cluster, with masses redistributed per frame."""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, side_by_side
from marey.markers.data.cluster_data import ClusterData, cluster_data, counted
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import RigidFit, fit_rigid, gap_notes, one_bone

_ROUNDS = 60
_SHORTENED = (1.0, 0.5, 0.2, 0.05, 0.01)
_KEPT = 1e-10  # of the largest moment
_LEAST_MASS = 1e-3  # of the unit mass at rest; a marker may all but vanish, never repel


def redistributed(points: Floats, mass: Floats, moments: Floats) -> tuple[Floats, Mask]:
    """Change masses until the cluster has the moments again that it had at rest.

    Minimises the sum of squared changes of the three eigenvalues ([Andriacchi1998] asks for eigenvalues that stay
    constant) by Gauss-Newton from the given masses, d moment_k / d m_i = (d_i . e_k)^2. More masses than eigenvalues
    leave a choice; every step is the shortest of those that do the same, and is shortened where the moments bend. A
    mass that falls to nothing is held there.

    Args:
        points: (F, M, 3) [m]; read only where the mass is above 0.
        mass: (F, M) masses to start from; 0 where a marker is missing.
        moments: (F, 3) second moments at rest, in any order [m2].

    Returns:
        The masses (F, M), and (F,) whether they keep the moments; where they do not, the given masses.
    """
    wanted = np.sort(moments, 1)
    found = mass.copy()
    active = np.arange(len(mass))
    for _ in range(_ROUNDS):
        found[active] = _step(points[active], found[active], wanted[active])
        active = active[_off(points[active], found[active], wanted[active]) > _KEPT / 100]
        if not len(active):
            break
    kept = _off(points, found, wanted) <= _KEPT
    return np.where(kept[:, None], found, mass), kept


def _step(points: Floats, mass: Floats, wanted: Floats) -> Floats:
    """Take one step towards the wanted moments, of the length among a few that leaves them least off."""
    now, slope = _moments(points, mass)
    change, held = np.zeros_like(mass), mass == 0
    for _ in range(2):  # the second time without the masses that the first would make vanish
        free = np.where(held[:, None], 0.0, slope)
        gain = np.linalg.pinv(free @ np.swapaxes(free, 1, 2), rcond=1e-14, hermitian=True)
        change = np.einsum("fkm,fkl,fl->fm", free, gain, wanted - now)
        held = held | (mass + change < _LEAST_MASS)
    candidates = [np.where(mass > 0, np.maximum(mass + s * change, _LEAST_MASS), 0.0) for s in _SHORTENED]
    off = [_off(points, candidate, wanted) for candidate in candidates]
    return np.asarray(np.stack(candidates)[np.argmin(off, 0), np.arange(len(mass))])


def _off(points: Floats, mass: Floats, wanted: Floats) -> Floats:
    """Tell how far the moments are off, over the largest one wanted (F,)."""
    return np.asarray(np.linalg.norm(_moments(points, mass)[0] - wanted, axis=1) / wanted.max(1))


def _moments(points: Floats, mass: Floats) -> tuple[Floats, Floats]:
    """Give the second moments (F, 3), smallest first, and their derivatives by the masses (F, 3, M)."""
    held = np.where(mass[..., None] > 0, points, 0.0)
    centre = np.einsum("fm,fmi->fi", mass, held) / mass.sum(1)[:, None]
    about = np.where(mass[..., None] > 0, points - centre[:, None], 0.0)
    moments, axes = np.linalg.eigh(np.swapaxes(about * mass[..., None], 1, 2) @ about)
    return moments, np.swapaxes((about @ axes) ** 2, 1, 2)


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
