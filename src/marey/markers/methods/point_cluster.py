"""Point cluster technique: centre of mass and principal axes of a cluster, with optional mass redistribution."""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, combine_bones
from marey.markers.data.cluster_data import ClusterData, cluster_data, frame_count_note
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import RigidFit, fit_rigid, gap_notes, one_bone

_MAXIMUM_STEPS = 60
"""Most Gauss-Newton steps of the mass redistribution. Chosen by hand."""
_STEP_FRACTIONS = (1.0, 0.5, 0.2, 0.05, 0.01)
"""Fractions of a step that are tried; the one with the smallest error is used. Chosen by hand."""
_MOMENT_TOLERANCE = 1e-10
"""The moments count as constant when their error is below this fraction of the largest one; numerical."""
_MINIMUM_MASS = 1e-3
"""Smallest mass of a visible marker as a fraction of the unit mass; it keeps masses positive. Chosen by hand."""
_LARGEST_AXIS_SD = np.radians(10)
"""Principal axes with a larger standard deviation [rad] do not determine an orientation. Chosen by hand."""


def redistribute_masses(points: Floats, mass: Floats, moments: Floats) -> tuple[Floats, Mask]:
    """Adjust masses until the cluster has the same second moments as in the reference.

    Minimises the sum of squared changes of the three eigenvalues ([Andriacchi1998] requires constant eigenvalues) by
    Gauss-Newton from the given masses, d moment_k / d m_i = (d_i . e_k)^2. The problem is underdetermined for more than
    three masses: every step has minimum norm, and is shortened where the moments are not linear. A mass that reaches
    the lower bound is held there.

    Args:
        points: (F, M, 3) [m]; read only where the mass is above 0.
        mass: (F, M) initial masses; 0 where a marker is missing.
        moments: (F, 3) second moments in the reference, in any order [m2].

    Returns:
        The masses (F, M), and (F,) whether the moments are constant; where they are not, the initial masses.
    """
    wanted = np.sort(moments, 1)
    found = mass.copy()
    active = np.arange(len(mass))
    for _ in range(_MAXIMUM_STEPS):
        found[active] = _step(points[active], found[active], wanted[active])
        active = active[_moment_error(points[active], found[active], wanted[active]) > _MOMENT_TOLERANCE / 100]
        if not len(active):
            break
    kept = _moment_error(points, found, wanted) <= _MOMENT_TOLERANCE
    return np.where(kept[:, None], found, mass), kept


def _step(points: Floats, mass: Floats, wanted: Floats) -> Floats:
    """Take one step towards the wanted moments, with the fraction that leaves the smallest error."""
    now, slope = _moments(points, mass)
    change, held = np.zeros_like(mass), mass == 0
    for _ in range(2):  # the second time without the masses that reach the lower bound
        free = np.where(held[:, None], 0.0, slope)
        gain = np.linalg.pinv(free @ np.swapaxes(free, 1, 2), rcond=1e-14, hermitian=True)
        change = np.einsum("fkm,fkl,fl->fm", free, gain, wanted - now)
        held = held | (mass + change < _MINIMUM_MASS)
    candidates = [np.where(mass > 0, np.maximum(mass + s * change, _MINIMUM_MASS), 0.0) for s in _STEP_FRACTIONS]
    off = [_moment_error(points, candidate, wanted) for candidate in candidates]
    return np.asarray(np.stack(candidates)[np.argmin(off, 0), np.arange(len(mass))])


def _moment_error(points: Floats, mass: Floats, wanted: Floats) -> Floats:
    """Return the error of the moments relative to the largest wanted one (F,)."""
    return np.asarray(np.linalg.norm(_moments(points, mass)[0] - wanted, axis=1) / wanted.max(1))


def _moments(points: Floats, mass: Floats) -> tuple[Floats, Floats]:
    """Return the second moments (F, 3) [m2] in ascending order, and their derivatives by the masses (F, 3, M)."""
    held = np.where(mass[..., None] > 0, points, 0.0)
    centre = np.einsum("fm,fmi->fi", mass, held) / mass.sum(1)[:, None]
    about = np.where(mass[..., None] > 0, points - centre[:, None], 0.0)
    moments, axes = np.linalg.eigh(np.swapaxes(about * mass[..., None], 1, 2) @ about)
    return moments, np.swapaxes((about @ axes) ** 2, 1, 2)


@dataclass(frozen=True, eq=False, kw_only=True)
class ClusterSystem:
    """The cluster's own coordinate system in F frames ([Alexander2003] eq. (2))."""

    centre: Floats
    """(F, 3) the centre of mass C [m]."""
    axes: Floats
    """(F, 3, 3) the principal axes of inertia E as columns; a proper rotation."""
    moments: Floats
    """(F, 3) second moments along these axes: sum of mass times distance squared [m2]. The moment of inertia about an
    axis is the sum of the other two."""


def cluster_system(points: Floats, mass: Floats, near: Floats) -> ClusterSystem:
    """Compute the centre of mass and the principal axes of points with masses.

    Eigenvalues determine neither the order nor the sign of the axes, and their order may change between frames: each
    axis is the one closest to its expected direction.

    Args:
        points: (F, M, 3) [m]; NaN where missing.
        mass: (F, M) 0 where missing.
        near: (F, 3, 3) expected axes as columns.

    Returns:
        The coordinate systems in all frames.
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
    """Assign an eigenvector (F, 3) and a sign (F, 3) to each expected axis by the cosines (F, expected, found)."""
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
    """Estimate every bone by its cluster's centre of mass and principal axes, with unit masses ([Andriacchi1998])."""
    return combine_bones([_bone(cluster_data(problem, c), problem.noise_m, masses=False) for c in problem.clusters])


def point_cluster_masses(problem: MarkerProblem) -> BoneMotion:
    """Do the same with masses chosen in each frame so that the eigenvalues are those of the reference."""
    return combine_bones([_bone(cluster_data(problem, c), problem.noise_m, masses=True) for c in problem.clusters])


def _bone(data: ClusterData, noise_m: float, *, masses: bool) -> BoneMotion:
    fit = fit_rigid(data.reference, data.points, noise_m)
    answered = ~fit.few & ~fit.collinear
    mass = np.where(data.present & answered[:, None], 1.0, 0.0)
    mass[~answered] = 1.0  # any mass; the frame is set to NaN below
    reference = np.broadcast_to(data.reference, data.points.shape)
    at_rest = cluster_system(reference, mass, np.broadcast_to(np.eye(3), fit.rotation.shape))
    near = np.where(answered[:, None, None], fit.rotation, np.eye(3)) @ at_rest.axes
    points = np.where(answered[:, None, None], data.points, reference)
    notes = list(data.notes)
    if masses:
        mass, kept = redistribute_masses(points, mass, at_rest.moments)
        notes += frame_count_note(
            data.segment, answered & ~kept, "keep unit masses: no positive masses give constant eigenvalues"
        )
    system = cluster_system(points, mass, near)
    rotation = system.axes @ np.swapaxes(at_rest.axes, 1, 2)  # [Alexander2003] eq. (5a): O = E E_cb^-1
    origin = system.centre - np.einsum("fij,fj->fi", rotation, at_rest.centre)  # P = C - O C_cb
    covariance = _covariance(points, mass, system, at_rest, noise_m)
    covariance *= np.fmax(fit.variance_ratio, 1.0)[:, None, None]
    undetermined = answered & ~(np.sqrt(np.linalg.eigvalsh(covariance[:, :3, :3])[:, 2]) < _LARGEST_AXIS_SD)
    notes += _gap_notes(data.segment, fit, undetermined)
    rotation[~answered | undetermined], origin[~answered | undetermined] = np.nan, np.nan
    covariance[~answered | undetermined] = np.nan
    return one_bone(data.segment, rotation, origin, covariance, tuple(notes))


def _gap_notes(segment: str, fit: RigidFit, undetermined: Mask) -> tuple[str, ...]:
    return (
        *gap_notes(segment, fit),
        *frame_count_note(
            segment, undetermined, "have moments of inertia too similar to distinguish the axes, and no result"
        ),
    )


def _covariance(points: Floats, mass: Floats, system: ClusterSystem, at_rest: ClusterSystem, noise_m: float) -> Floats:
    """Compute the covariance (F, 6, 6) of the bones' poses to first order from the markers' noise.

    A displacement n of a marker at d in the cluster's axes rotates the axes a and b into each other by
    mass (d_a n_b + d_b n_a) / (moment_a - moment_b): nearly equal moments leave the axes undetermined.
    """
    total = mass.sum(1)[:, None, None]
    local = np.where(mass[..., None] > 0, points - system.centre[:, None], 0.0) @ system.axes
    jacobian = np.zeros((*local.shape[:2], 6, 3))  # of rotation and centre in the cluster's axes
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
