"""Rigid fit: the rotation and translation that best align a cluster's shape with its markers in each frame."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations
from marey.markers.data.bone_motion import BoneMotion, combine_bones
from marey.markers.data.cluster_data import ClusterData, cluster_data, frame_count_note
from marey.markers.data.clusters import MINIMUM_MARKERS
from marey.markers.data.problem import MarkerProblem

EQUAL_SD_M = 1e-3
"""Standard deviation of a coordinate [m] for fits in which all markers have equal weight; it only decides which
clusters count as collinear. Chosen by hand."""
_OFF_LINE_SD = 3.0
"""Markers whose weighted spread across their main line is below this many standard deviations count as collinear: they
do not determine the rotation about the line. The usual three-sigma limit."""
_OFF_LINE_RATIO = 1e-6
"""The same limit as a ratio to the spread along the line, for markers without noise; a numerical tolerance."""
_ALIGNMENTS = 4
"""Rounds of alignment of all frames with the mean shape. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RigidFit:
    """F rigid motions of one cluster of M markers."""

    rotation: Floats
    """(F, 3, 3) laboratory from the frame of the shape; NaN where the frame does not determine it."""
    translation: Floats
    """(F, 3) the shape's origin in the laboratory [m]."""
    residuals: Floats
    """(F, M, 3) measured minus fitted position along the laboratory's axes [m]; NaN for unused markers."""
    noise_covariance: Floats
    """(F, 6, 6) as `BoneMotion.covariance`, to first order, from the given noise alone."""
    variance_ratio: Floats
    """(F,) the residuals' variance divided by the given variance; NaN without an estimate."""
    few: Mask
    """(F,) True where fewer than `MINIMUM_MARKERS` markers are visible."""
    collinear: Mask
    """(F,) True where the markers are collinear within their noise."""

    @property
    def covariance(self) -> Floats:
        """(F, 6, 6) covariance, scaled by the variance ratio in frames where that exceeds 1."""
        return np.asarray(self.noise_covariance * np.fmax(self.variance_ratio, 1.0)[:, None, None])


def fit_rigid(shape: Floats, points: Floats, sd: Floats | float) -> RigidFit:
    """Fit a shape to its markers in every frame by weighted least squares over rotation and translation.

    Unlike the paper ([Spoor1980]), which uses the eigenvalues of the squared cross-dispersion matrix, the rotation
    comes from its singular values, and each marker is weighted by its standard deviation.

    Args:
        shape: (M, 3) or (F, M, 3) the markers in the shape's frame [m]; NaN where unknown.
        points: (F, M, 3) in the laboratory [m]; NaN where missing.
        sd: () or (M,) or (F, M) standard deviation of a marker's coordinate [m], above 0.

    Returns:
        The rotations and translations, with residuals and covariance.
    """
    shape = np.broadcast_to(shape, points.shape)
    used: Mask = np.asarray(np.isfinite(points).all(-1) & np.isfinite(shape).all(-1))
    sd = np.broadcast_to(np.asarray(sd, float), used.shape)
    weight = np.where(used, 1 / sd**2, 0.0)
    to, from_ = _centred(points, weight), _centred(shape, weight)
    few = used.sum(1) < MINIMUM_MARKERS
    collinear = ~few & _in_line(from_[1], to[1], weight)
    answered = ~few & ~collinear
    cross = _dispersion(weight, to[1], from_[1])
    rotation = np.full((len(points), 3, 3), np.nan)
    rotation[answered] = rotations.nearest(cross[answered])
    translation = to[0] - np.einsum("fij,fj->fi", rotation, from_[0])
    residuals = points - np.einsum("fij,fmj->fmi", rotation, shape) - translation[:, None]
    return RigidFit(
        rotation=rotation, translation=translation, residuals=residuals,
        noise_covariance=_covariance(rotation, shape, weight), variance_ratio=_ratio(residuals, weight, used),
        few=few, collinear=collinear,
    )  # fmt: skip


def _centred(points: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the weighted centroids (F, 3) and the points relative to them (F, M, 3), 0 where the weight is 0."""
    total = weight.sum(1)
    held = np.where(weight[..., None] > 0, points, 0.0)
    centroid = np.einsum("fm,fmi->fi", weight, held) / np.where(total > 0, total, np.nan)[:, None]
    return centroid, np.where(weight[..., None] > 0, points - centroid[:, None], 0.0)


def _dispersion(weight: Floats, first: Floats, second: Floats) -> Floats:
    """Sum weight * first * second' over the markers: (F, 3, 3). A matrix product takes 10 % of an einsum's time."""
    return np.asarray(np.swapaxes(weight[..., None] * first, 1, 2) @ second)


def _in_line(shape: Floats, points: Floats, weight: Floats) -> Mask:
    """Find the frames (F,) whose shape or markers are collinear within their noise."""
    in_line = np.zeros(len(shape), bool)
    for centred in (shape, points):
        spread = np.linalg.eigvalsh(_dispersion(weight, centred, centred))  # in units of the noise variance
        in_line |= spread[:, 1] < np.maximum(_OFF_LINE_SD**2, _OFF_LINE_RATIO**2 * spread[:, 2])
    return in_line


def _covariance(rotation: Floats, shape: Floats, weight: Floats) -> Floats:
    """Invert the markers' information (F, 6, 6) on the rotation about the shape's axes and on its origin."""
    held = np.where(weight[..., None] > 0, shape, 0.0)
    turn = -rotation[:, None] @ rotations.hat(held)
    jacobian = np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], -1)
    whitened = (np.sqrt(weight)[..., None, None] * jacobian).reshape(len(jacobian), -1, 6)
    information = np.swapaxes(whitened, 1, 2) @ whitened
    answered = np.isfinite(rotation).all((1, 2))
    covariance = np.full_like(information, np.nan)
    covariance[answered] = np.linalg.inv(information[answered])
    return np.asarray(covariance)


def _ratio(residuals: Floats, weight: Floats, used: Mask) -> Floats:
    """Return the weighted sum of squared residuals divided by the degrees of freedom (F,)."""
    squared = np.where(used[..., None], residuals**2, 0.0).sum(-1)
    return np.asarray((weight * squared).sum(1) / np.maximum(3 * used.sum(1) - 6, 1))


def in_cluster_frame(points: Floats, shape: Floats | None = None) -> tuple[Floats, Floats, Floats]:
    """Remove the rigid motion from a cluster's markers.

    Each frame is aligned with the mean shape, which is the mean of the aligned frames.

    Args:
        points: (F, M, 3) in the laboratory [m]; NaN where missing.
        shape: (M, 3) an approximate mean shape; None to start from the frame with the most markers.

    Returns:
        The markers in the cluster's frame (F, M, 3), and laboratory from cluster: rotation (F, 3, 3) and translation
        (F, 3). NaN in frames with fewer than three markers, or with collinear markers.
    """
    rounds = _ALIGNMENTS if shape is None else 1
    shape = points[np.argmax(np.isfinite(points).all(-1).sum(1))] if shape is None else shape
    for _ in range(rounds):
        fit = fit_rigid(shape, points, EQUAL_SD_M)
        local = np.einsum("fji,fmj->fmi", fit.rotation, points - fit.translation[:, None])
        shape = mean_shape(local)
    return local, fit.rotation, fit.translation


def mean_shape(local: Floats) -> Floats:
    """Average over the frames that are known; NaN for what never is."""
    known = np.isfinite(local)
    count = known.sum(0)
    return np.where(count > 0, np.where(known, local, 0).sum(0) / np.maximum(count, 1), np.nan)


def rigid(problem: MarkerProblem) -> BoneMotion:
    """Estimate every bone by a rigid fit of its cluster's shape ([Spoor1980]).

    The shape is the cluster's in the known posture; with several postures, the mean of the marker positions over them,
    so that the estimate in a known posture differs from the known pose.
    """
    return combine_bones([rigid_bone(cluster_data(problem, cluster), problem.noise_m) for cluster in problem.clusters])


def rigid_bone(data: ClusterData, noise_m: float) -> BoneMotion:
    """Fit one cluster's shape rigidly; the reference's noise decreases with the number of postures of a marker."""
    sd = noise_m * np.sqrt(1 + 1 / np.maximum(np.isfinite(data.postures).all(-1).sum(0), 1))
    fit = fit_rigid(data.reference, data.points, sd)
    notes = (*data.notes, *gap_notes(data.segment, fit))
    return one_bone(data.segment, fit.rotation, fit.translation, fit.covariance, notes)


def gap_notes(segment: str, fit: RigidFit) -> tuple[str, ...]:
    """Report how many frames have no result, and why."""
    return (
        *frame_count_note(segment, fit.few, f"have fewer than {MINIMUM_MARKERS} markers and no result"),
        *frame_count_note(segment, fit.collinear, "have collinear markers and no result"),
    )


def one_bone(
    segment: str, rotation: Floats, origin: Floats, covariance: Floats, notes: tuple[str, ...] = ()
) -> BoneMotion:
    """Create the motion of one bone from rotation (F, 3, 3), origin (F, 3) and covariance (F, 6, 6)."""
    return BoneMotion(
        segments=(segment,), rotation=rotation[:, None], origin=origin[:, None], covariance=covariance[:, None],
        notes=notes,
    )  # fmt: skip
