"""Reduction of a problem to the known postures and visible segments that a method can use."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Integers, Mask
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.problem import MarkerProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedProblem:
    """A problem reduced to what a method can use."""

    problem: MarkerProblem | None
    """The reduced problem; None if no segment is left."""
    segments: tuple[str, ...]
    """All requested segments."""
    frames: int
    """Number of frames of the trial."""
    notes: tuple[str, ...]
    """What was removed and why, one sentence each."""

    def with_all_segments(self, motion: BoneMotion | None) -> BoneMotion:
        """Return the motion of all requested segments; NaN for those that were removed."""
        shape = (self.frames, len(self.segments))
        rotation, origin = np.full((*shape, 3, 3), np.nan), np.full((*shape, 3), np.nan)
        covariance, notes = np.full((*shape, 6, 6), np.nan), self.notes
        if motion is not None:
            index = [self.segments.index(segment) for segment in motion.segments]
            rotation[:, index], origin[:, index] = motion.rotation, motion.origin
            covariance[:, index], notes = motion.covariance, (*notes, *motion.notes)
        return BoneMotion(segments=self.segments, rotation=rotation, origin=origin, covariance=covariance, notes=notes)


def prepare_problem(problem: MarkerProblem) -> PreparedProblem:
    """Remove postures in which a bone is unknown, and segments of which no known posture shows a marker.

    A posture is used for all segments or for none; segments that are unknown in all postures are removed first.
    """
    segments = tuple(cluster.segment for cluster in problem.clusters)
    calibration, notes = problem.calibration, list[str]()
    known = _known(calibration)
    clusters = [c for c in problem.clusters if known[:, calibration.segments.index(c.segment)].any()]
    without = [cluster.segment for cluster in problem.clusters if cluster not in clusters]
    notes += [f"{segment}: its bone is not known in any posture and cannot be estimated." for segment in without]
    index = [calibration.segments.index(cluster.segment) for cluster in clusters]
    postures = np.flatnonzero(known[:, index].all(1)) if clusters else np.zeros(0, np.int64)
    if clusters and len(postures) < calibration.postures:
        frames = ", ".join(str(f) for f in np.delete(calibration.frames, postures))
        notes.append(f"The postures of frame {frames} are not used, because a bone is unknown there.")
    seen = [cluster for cluster in clusters if _shown(problem, cluster, postures)]
    unseen = [cluster.segment for cluster in clusters if cluster not in seen]
    notes += [
        f"{segment}: none of its markers is visible in a known posture; the bone cannot be estimated."
        for segment in unseen
    ]
    left = _reduced(problem, tuple(seen), postures) if seen else None
    return PreparedProblem(problem=left, segments=segments, frames=len(problem.trajectories), notes=tuple(notes))


def _known(calibration: AnatomicalCalibration) -> Mask:
    """Find the postures (K, S) in which a bone is known."""
    return np.asarray(np.isfinite(calibration.rotation).all((2, 3)) & np.isfinite(calibration.origin).all(2))


def _shown(problem: MarkerProblem, cluster: Cluster, postures: Integers) -> bool:
    points = problem.trajectories.select(cluster.labels).points[problem.calibration.frames[postures]]
    return bool(np.isfinite(points).all(-1).any())


def _reduced(problem: MarkerProblem, clusters: tuple[Cluster, ...], postures: Integers) -> MarkerProblem:
    calibration, names = problem.calibration, {cluster.segment for cluster in clusters}
    kept = [number for number, pair in enumerate(problem.joints) if set(pair) <= names]
    return replace(
        problem,
        clusters=clusters,
        calibration=AnatomicalCalibration(
            segments=calibration.segments, frames=calibration.frames[postures],
            rotation=calibration.rotation[postures], origin=calibration.origin[postures],
        ),
        joints=tuple(problem.joints[number] for number in kept),
        degrees_of_freedom=tuple(problem.degrees_of_freedom[n] for n in kept) if problem.degrees_of_freedom else (),
    )  # fmt: skip
