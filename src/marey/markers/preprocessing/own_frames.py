"""Anatomical calibrations from the cluster's own axes, or transferred from another trial."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.markers.data.clusters import MINIMUM_MARKERS, AnatomicalCalibration, Cluster
from marey.markers.data.rigid_fit import EQUAL_SD_M, fit_rigid
from marey.markers.data.trajectories import MarkerTrajectories


def calibration_from_cluster_axes(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster]
) -> AnatomicalCalibration:
    """Use each cluster's principal axes in one frame of the trial as the bone's axes.

    The frame is the first one with the most markers of all clusters. The origin is the markers' mean; the axes are the
    principal ones, longest first, with the sign that makes the largest component positive. Rotations since that frame
    are meaningful in such axes, anatomical angles are not.

    Args:
        trajectories: Marker trajectories of the trial.
        clusters: One cluster per segment.

    Returns:
        The calibration in that frame.

    Raises:
        MareyError: No frame shows three markers of each cluster.
    """
    counts = np.stack([trajectories.select(cluster.labels).present.sum(1) for cluster in clusters], 1)
    enough = (counts >= MINIMUM_MARKERS).all(1)
    if not enough.any():
        raise MareyError(f"No frame shows {MINIMUM_MARKERS} markers of every segment: there is no reference frame.")
    frame = int(np.argmax(np.where(enough, counts.sum(1), -1)))
    poses = [_principal(trajectories.select(cluster.labels).points[frame]) for cluster in clusters]
    return AnatomicalCalibration(
        segments=tuple(cluster.segment for cluster in clusters),
        frames=np.array([frame]),
        rotation=np.stack([rotation for rotation, _ in poses])[None],
        origin=np.stack([origin for _, origin in poses])[None],
    )


def _principal(points: Floats) -> tuple[Floats, Floats]:
    """Return the principal axes (3, 3) and the mean (3,) of the visible points (M, 3)."""
    there = points[np.isfinite(points).all(-1)]
    origin = there.mean(0)
    axes = np.linalg.svd(there - origin, full_matrices=True)[2].T
    largest = axes[np.abs(axes).argmax(0), np.arange(3)]
    axes = axes * np.where(largest < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes, origin


@dataclass(frozen=True, eq=False, kw_only=True)
class BonesAndMarkers:
    """Bones and the positions of their markers in one posture of another trial."""

    segments: tuple[str, ...]
    """S names."""
    rotation: Floats
    """(S, 3, 3) that trial's laboratory from bone."""
    origin: Floats
    """(S, 3) [m]."""
    labels: tuple[str, ...]
    """M marker labels."""
    points: Floats
    """(M, 3) positions of the markers in that posture [m]; NaN where missing."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TransferredCalibration:
    """A calibration transferred from one trial into another."""

    calibration: AnatomicalCalibration
    clusters: tuple[Cluster, ...]
    """Clusters whose bones are known in the other trial."""
    residual_m: Floats
    """(S,) RMS distance of the markers in that posture from those of the chosen frame [m]."""
    notes: tuple[str, ...]
    """What was skipped, one sentence each."""


def transfer_calibration(
    known: BonesAndMarkers, trajectories: MarkerTrajectories, clusters: Sequence[Cluster]
) -> TransferredCalibration:
    """Transfer bones that are known in a posture of another trial into this one.

    In the frame in which the clusters are most similar to those of the posture, each cluster is aligned with its
    counterpart as a rigid body, and the bone moves with it. Skin motion between the two is the error of the transferred
    bone.

    Args:
        known: Bones and markers of the posture.
        trajectories: Marker trajectories of this trial.
        clusters: Clusters of this trial.

    Returns:
        The calibration in the chosen frame, with its residuals.

    Raises:
        MareyError: No bone has three markers in common, or no frame shows them.
    """
    shared = {cluster.segment: _common(cluster, known) for cluster in clusters}
    notes = [f"{name} is unknown in the other trial, or has fewer than {MINIMUM_MARKERS} common markers; skipped."
             for name, labels in shared.items() if len(labels) < MINIMUM_MARKERS]  # fmt: skip
    kept = [cluster for cluster in clusters if len(shared[cluster.segment]) >= MINIMUM_MARKERS]
    if not kept:
        raise MareyError("No segment has three markers in common with the posture in which the bones are known.")
    fits = []
    for cluster in kept:
        labels = shared[cluster.segment]
        shape = known.points[[known.labels.index(label) for label in labels]]
        fits.append(fit_rigid(shape, trajectories.select(labels).points, EQUAL_SD_M))
    squares = np.stack([_mean_square(fit.residuals) for fit in fits], 1)
    missing = np.stack([np.isnan(fit.residuals).any((-1, -2)) for fit in fits], 1)
    answered = np.isfinite(squares).all(1)
    if not answered.any():
        raise MareyError("No frame shows three markers of every segment whose bone is known in the other trial.")
    whole = answered & ~missing.any(1)
    frame = int(np.argmin(np.where(whole if whole.any() else answered, squares.sum(1), np.inf)))
    index = [known.segments.index(cluster.segment) for cluster in kept]
    rotation = np.stack([fit.rotation[frame] @ known.rotation[i] for fit, i in zip(fits, index, strict=True)])
    origin = np.stack(
        [fit.rotation[frame] @ known.origin[i] + fit.translation[frame] for fit, i in zip(fits, index, strict=True)]
    )
    return TransferredCalibration(
        calibration=AnatomicalCalibration(
            segments=tuple(cluster.segment for cluster in kept), frames=np.array([frame]), rotation=rotation[None],
            origin=origin[None],
        ),
        clusters=tuple(kept), residual_m=np.sqrt(squares[frame]), notes=tuple(notes),
    )  # fmt: skip


def _common(cluster: Cluster, known: BonesAndMarkers) -> tuple[str, ...]:
    if cluster.segment not in known.segments:
        return ()
    there = np.asarray(np.isfinite(known.points).all(-1))
    seen = {label for label, is_there in zip(known.labels, there, strict=True) if is_there}
    return tuple(label for label in cluster.labels if label in seen)


def _mean_square(residuals: Floats) -> Floats:
    """Return the mean squared distance (F,) of residuals (F, M, 3) [m2]; NaN without residuals."""
    squares = (residuals**2).sum(-1)
    known = np.isfinite(squares)
    total = np.where(known, squares, 0.0).sum(1)
    return np.where(known.any(1), total / np.maximum(known.sum(1), 1), np.nan)
