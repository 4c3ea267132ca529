"""One cluster's markers as the methods work on them: its paths, and its places on the bone in each known posture."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError
from marey.markers.data.clusters import Cluster
from marey.markers.data.problem import MarkerProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class ClusterData:
    """The M markers of a cluster that are seen in a known posture at least once, over F frames and K postures."""

    segment: str
    labels: tuple[str, ...]
    """M labels."""
    points: Floats
    """(F, M, 3) in the laboratory [m]; NaN where missing."""
    postures: Floats
    """(K, M, 3) each marker's place in the bone's frame in each known posture [m]; NaN where missing."""
    frames: Integers
    """(K,) the frames of the known postures."""
    rotation: Floats
    """(K, 3, 3) laboratory from bone in the known postures."""
    origin: Floats
    """(K, 3) the bone's origin in the known postures [m]."""
    notes: tuple[str, ...]
    """What was passed over."""

    @property
    def reference(self) -> Floats:
        """(M, 3) each marker's place in the bone's frame: the mean over the postures that show it [m]."""
        known = np.isfinite(self.postures).all(-1, keepdims=True)
        total = np.where(known, self.postures, 0.0).sum(0)
        return np.asarray(total / known.sum(0))

    @property
    def present(self) -> Mask:
        """(F, M) true where a marker has a place."""
        return np.asarray(np.isfinite(self.points).all(-1))


def cluster_data(problem: MarkerProblem, cluster: Cluster) -> ClusterData:
    """Gather one cluster's paths and the places that its markers have on the bone in the known postures.

    A marker that no known posture shows has no place on the bone; it is passed over, and said.

    Raises:
        MareyError: The calibration does not know the segment, or a posture lies outside the trial.
    """
    calibration = problem.calibration
    if cluster.segment not in calibration.segments:
        known = ", ".join(calibration.segments)
        raise MareyError(f"The anatomical calibration has no segment {cluster.segment!r}. It has: {known}.")
    count = len(problem.trajectories)
    if calibration.frames.min() < 0 or calibration.frames.max() >= count:
        raise MareyError(f"The calibration names frame {calibration.frames.max()}; the trial has {count} frames.")
    index = calibration.segments.index(cluster.segment)
    points = problem.trajectories.select(cluster.labels).points
    rotation, origin = calibration.rotation[:, index], calibration.origin[:, index]
    postures = np.einsum("kba,kmb->kma", rotation, points[calibration.frames] - origin[:, None])
    seen = np.isfinite(postures).all(-1).any(0)
    unseen = [label for label, there in zip(cluster.labels, seen, strict=True) if not there]
    notes = (f"{cluster.segment}: passed over {', '.join(unseen)}, in no known posture.",) if unseen else ()
    return ClusterData(
        segment=cluster.segment,
        labels=tuple(label for label, there in zip(cluster.labels, seen, strict=True) if there),
        points=points[:, seen], postures=postures[:, seen], frames=calibration.frames, rotation=rotation,
        origin=origin, notes=notes,
    )  # fmt: skip


def counted(segment: str, where: Mask, why: str) -> tuple[str, ...]:
    """Say for how many frames (F,) something holds; nothing where it holds for none."""
    number = int(where.sum())
    return (f"{segment}: {number} of {len(where)} frames {why}.",) if number else ()
