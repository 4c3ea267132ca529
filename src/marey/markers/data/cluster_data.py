"""The data of one cluster: marker trajectories, and marker positions on the bone in each known posture."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError
from marey.markers.data.clusters import Cluster
from marey.markers.data.problem import MarkerProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class ClusterData:
    """The M markers of a cluster that are visible in at least one known posture, over F frames and K postures."""

    segment: str
    labels: tuple[str, ...]
    """M labels."""
    points: Floats
    """(F, M, 3) in the laboratory [m]; NaN where missing."""
    postures: Floats
    """(K, M, 3) each marker's position in the bone's frame in each known posture [m]; NaN where missing."""
    frames: Integers
    """(K,) frame indices of the known postures."""
    rotation: Floats
    """(K, 3, 3) laboratory from bone in the known postures."""
    origin: Floats
    """(K, 3) the bone's origin in the known postures [m]."""
    notes: tuple[str, ...]
    """What was skipped, one sentence each."""

    @property
    def reference(self) -> Floats:
        """(M, 3) each marker's position in the bone's frame: the mean over the postures that show it [m]."""
        known = np.isfinite(self.postures).all(-1, keepdims=True)
        total = np.where(known, self.postures, 0.0).sum(0)
        return np.asarray(total / known.sum(0))

    @property
    def present(self) -> Mask:
        """(F, M) True where a marker has a position."""
        return np.asarray(np.isfinite(self.points).all(-1))


def cluster_data(problem: MarkerProblem, cluster: Cluster) -> ClusterData:
    """Collect one cluster's trajectories and the positions of its markers on the bone in the known postures.

    A marker that no known posture shows has no position on the bone; it is skipped and reported in the notes.

    Raises:
        MareyError: The calibration lacks the segment, or a posture lies outside the trial.
    """
    calibration = problem.calibration
    if cluster.segment not in calibration.segments:
        known = ", ".join(calibration.segments)
        raise MareyError(f"The anatomical calibration has no segment {cluster.segment!r}. It has: {known}.")
    count = len(problem.trajectories)
    if calibration.frames.min() < 0 or calibration.frames.max() >= count:
        raise MareyError(f"The calibration refers to frame {calibration.frames.max()}; the trial has {count} frames.")
    index = calibration.segments.index(cluster.segment)
    points = problem.trajectories.select(cluster.labels).points
    rotation, origin = calibration.rotation[:, index], calibration.origin[:, index]
    postures = np.einsum("kba,kmb->kma", rotation, points[calibration.frames] - origin[:, None])
    seen = np.isfinite(postures).all(-1).any(0)
    unseen = [label for label, there in zip(cluster.labels, seen, strict=True) if not there]
    notes = (f"{cluster.segment}: skipped {', '.join(unseen)}, not visible in any known posture.",) if unseen else ()
    return ClusterData(
        segment=cluster.segment,
        labels=tuple(label for label, there in zip(cluster.labels, seen, strict=True) if there),
        points=points[:, seen], postures=postures[:, seen], frames=calibration.frames, rotation=rotation,
        origin=origin, notes=notes,
    )  # fmt: skip


def frame_count_note(segment: str, where: Mask, why: str) -> tuple[str, ...]:
    """Report for how many frames of a mask (F,) something holds; empty where it holds for none."""
    number = int(where.sum())
    return (f"{segment}: {number} of {len(where)} frames {why}.",) if number else ()
