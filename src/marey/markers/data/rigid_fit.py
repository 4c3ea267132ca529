"""The rigid fit: the rotation and translation that carry a cluster's shape nearest to its markers, frame by frame."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, side_by_side
from marey.markers.data.cluster_data import ClusterData, cluster_data, counted
from marey.markers.data.problem import MarkerProblem

FEWEST = 3
_OFF_LINE = 3.0  # standard deviations; markers nearer than this to one line do not tell the turn about it
_OFF_LINE_SHARE = 1e-6  # of the cluster's length, for markers without noise


@dataclass(frozen=True, eq=False, kw_only=True)
class RigidFit:
    """F rigid motions of one cluster of M markers."""

    rotation: Floats
    """(F, 3, 3) laboratory from the frame of the shape; NaN where the frame has no answer."""
    translation: Floats
    """(F, 3) the shape's origin in the laboratory [m]."""
    residuals: Floats
    """(F, M, 3) measured less fitted along the laboratory's axes [m]; NaN for what was not used."""
    noise_covariance: Floats
    """(F, 6, 6) as `BoneMotion.covariance`, to first order, from the stated noise alone."""
    variance_ratio: Floats
    """(F,) the residuals' variance as a multiple of the stated one; NaN without an answer."""
    few: Mask
    """(F,) true where fewer than three markers were there."""
    collinear: Mask
    """(F,) true where the markers lay in a line, as far as their noise lets one tell."""

    @property
    def covariance(self) -> Floats:
        """(F, 6, 6) with the residuals' own variance in the frames where it is larger than the stated one."""
        return np.asarray(self.noise_covariance * np.fmax(self.variance_ratio, 1.0)[:, None, None])


def fit_rigid(shape: Floats, points: Floats, sd: Floats | float, *, own_form: bool = False) -> RigidFit:
    """Fit a shape to its markers in every frame: weighted least squares over rotation and translation.

    Both forms give the same rotation; the singular values' form is the faster one here, the eigenvalues' form is the
    paper's ([Spoor1980]). Unlike the paper, each marker counts by its standard deviation.

    Args:
        shape: (M, 3) or (F, M, 3) the markers in the shape's frame [m]; NaN where not known.
        points: (F, M, 3) in the laboratory [m]; NaN where missing.
        sd: () or (M,) or (F, M) standard deviation of a marker's coordinate [m], above 0.
        own_form: Use the eigenvalues' form.
    """
    shape = np.broadcast_to(shape, points.shape)
    used: Mask = np.asarray(np.isfinite(points).all(-1) & np.isfinite(shape).all(-1))
    sd = np.broadcast_to(np.asarray(sd, float), used.shape)
    weight = np.where(used, 1 / sd**2, 0.0)
    to, from_ = _centred(points, weight), _centred(shape, weight)
    few = used.sum(1) < FEWEST
    collinear = ~few & _in_line(from_[1], to[1], weight)
    answered = ~few & ~collinear
    cross = _dispersion(weight, to[1], from_[1])
    rotation = np.full((len(points), 3, 3), np.nan)
    rotation[answered] = (by_eigenvalues if own_form else rotations.nearest)(cross[answered])
    translation = to[0] - np.einsum("fij,fj->fi", rotation, from_[0])
    residuals = points - np.einsum("fij,fmj->fmi", rotation, shape) - translation[:, None]
    return RigidFit(
        rotation=rotation, translation=translation, residuals=residuals,
        noise_covariance=_covariance(rotation, shape, weight), variance_ratio=_ratio(residuals, weight, used),
        few=few, collinear=collinear,
    )  # fmt: skip


def by_eigenvalues(cross: Floats) -> Floats:
    """Find the rotations nearest to cross-dispersion matrices by the eigenvalues of M'M ([Spoor1980]).

    The two larger eigenvalues and their vectors fix the rotation; the third axis is the cross product of the first
    two, so that a plane cluster needs no special care and no reflection can come out.

    Args:
        cross: (..., 3, 3) sum of weight * point * shape' about the centroids.

    Returns:
        (..., 3, 3).
    """
    squared, vectors = np.linalg.eigh(np.swapaxes(cross, -1, -2) @ cross)
    first, second = vectors[..., 2], vectors[..., 1]
    length = np.sqrt(squared[..., None, :])
    turned_first = (cross @ first[..., None])[..., 0] / length[..., 2]
    turned_second = (cross @ second[..., None])[..., 0] / length[..., 1]
    before = np.stack([first, second, np.cross(first, second)], -1)
    after = np.stack([turned_first, turned_second, np.cross(turned_first, turned_second)], -1)
    return np.asarray(after @ np.swapaxes(before, -1, -2))


def _centred(points: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Give the weighted centroids (F, 3) and the points about them (F, M, 3), 0 where there is no weight."""
    total = weight.sum(1)
    held = np.where(weight[..., None] > 0, points, 0.0)
    centroid = np.einsum("fm,fmi->fi", weight, held) / np.where(total > 0, total, np.nan)[:, None]
    return centroid, np.where(weight[..., None] > 0, points - centroid[:, None], 0.0)


def _dispersion(weight: Floats, first: Floats, second: Floats) -> Floats:
    """Sum weight * first * second' over the markers: (F, 3, 3). A matrix product takes a tenth of an einsum's time."""
    return np.asarray(np.swapaxes(weight[..., None] * first, 1, 2) @ second)


def _in_line(shape: Floats, points: Floats, weight: Floats) -> Mask:
    """Tell the frames (F,) whose shape or markers lie in a line, as far as their noise lets one tell."""
    in_line = np.zeros(len(shape), bool)
    for centred in (shape, points):
        spread = np.linalg.eigvalsh(_dispersion(weight, centred, centred))  # in variances of the noise
        in_line |= spread[:, 1] < np.maximum(_OFF_LINE**2, _OFF_LINE_SHARE**2 * spread[:, 2])
    return in_line


def _covariance(rotation: Floats, shape: Floats, weight: Floats) -> Floats:
    """Invert the information (F, 6, 6) that the markers give of the turn about the shape's axes and of its origin."""
    held = np.where(weight[..., None] > 0, shape, 0.0)
    turn = -rotation[:, None] @ rotations.hat(held)
    jacobian = np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], -1)
    whitened = (np.sqrt(weight)[..., None, None] * jacobian).reshape(len(jacobian), -1, 6)
    information = np.swapaxes(whitened, 1, 2) @ whitened
    answered = np.isfinite(rotation).all((1, 2))
    covariance = np.full_like(information, np.nan)
    covariance[answered] = np.linalg.inv(information[answered])
    return covariance


def _ratio(residuals: Floats, weight: Floats, used: Mask) -> Floats:
    """Give the sum of squared residuals in their standard deviations, over the number left free (F,)."""
    squared = np.where(used[..., None], residuals**2, 0.0).sum(-1)
    return np.asarray((weight * squared).sum(1) / np.maximum(3 * used.sum(1) - 6, 1))


def rigid(problem: MarkerProblem) -> BoneMotion:
    """Move every bone as its cluster's shape, fitted rigidly ([Spoor1980]).

    The shape is the cluster's in the known posture; with several, the mean of the markers' places over them, so that
    the answer in a known posture is no longer the known pose itself.
    """
    return side_by_side([rigid_bone(cluster_data(problem, cluster), problem.noise_m) for cluster in problem.clusters])


def rigid_bone(data: ClusterData, noise_m: float) -> BoneMotion:
    """Fit one cluster's shape rigidly; its reference is as noisy as its markers, as many times as it was seen."""
    sd = noise_m * np.sqrt(1 + 1 / np.maximum(np.isfinite(data.postures).all(-1).sum(0), 1))
    fit = fit_rigid(data.reference, data.points, sd)
    notes = (*data.notes, *gap_notes(data.segment, fit))
    return one_bone(data.segment, fit.rotation, fit.translation, fit.covariance, notes)


def gap_notes(segment: str, fit: RigidFit) -> tuple[str, ...]:
    """Say how many frames have no answer, and why."""
    return (
        *counted(segment, fit.few, f"have fewer than {FEWEST} markers and no answer"),
        *counted(segment, fit.collinear, "have their markers in a line and no answer"),
    )


def one_bone(
    segment: str, rotation: Floats, origin: Floats, covariance: Floats, notes: tuple[str, ...] = ()
) -> BoneMotion:
    """Make the motion of one bone from rotation (F, 3, 3), origin (F, 3) and covariance (F, 6, 6)."""
    return BoneMotion(
        segments=(segment,), rotation=rotation[:, None], origin=origin[:, None], covariance=covariance[:, None],
        notes=notes,
    )  # fmt: skip
