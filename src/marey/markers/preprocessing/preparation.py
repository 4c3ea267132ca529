"""What a method can work with: postures that are known, segments that have markers; the rest set aside and said."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Integers, Mask
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.problem import MarkerProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedProblem:
    """A problem with what no method can use set aside."""

    problem: MarkerProblem | None
    """What is left; None where no segment is."""
    segments: tuple[str, ...]
    """All segments that were asked for."""
    frames: int
    notes: tuple[str, ...]
    """What was set aside."""

    def whole(self, motion: BoneMotion | None) -> BoneMotion:
        """Give the motion of all segments that were asked for; NaN for those that were set aside."""
        shape = (self.frames, len(self.segments))
        rotation, origin = np.full((*shape, 3, 3), np.nan), np.full((*shape, 3), np.nan)
        covariance, notes = np.full((*shape, 6, 6), np.nan), self.notes
        if motion is not None:
            index = [self.segments.index(segment) for segment in motion.segments]
            rotation[:, index], origin[:, index] = motion.rotation, motion.origin
            covariance[:, index], notes = motion.covariance, (*notes, *motion.notes)
        return BoneMotion(segments=self.segments, rotation=rotation, origin=origin, covariance=covariance, notes=notes)


def prepared(problem: MarkerProblem) -> PreparedProblem:
    """Set aside postures in which a bone is not known, and segments of which no posture shows a marker.

    A posture counts for all segments or for none; a segment known in no posture is set aside first.
    """
    segments = tuple(cluster.segment for cluster in problem.clusters)
    calibration, notes = problem.calibration, list[str]()
    known = _known(calibration)
    clusters = [c for c in problem.clusters if known[:, calibration.segments.index(c.segment)].any()]
    without = [cluster.segment for cluster in problem.clusters if cluster not in clusters]
    notes += [f"{segment}: its bone is known in no posture; no answer." for segment in without]
    index = [calibration.segments.index(cluster.segment) for cluster in clusters]
    postures = np.flatnonzero(known[:, index].all(1)) if clusters else np.zeros(0, np.int64)
    if clusters and len(postures) < calibration.postures:
        frames = ", ".join(str(f) for f in np.delete(calibration.frames, postures))
        notes.append(f"The postures of frame {frames} are not used: a bone is not known there.")
    seen = [cluster for cluster in clusters if _shown(problem, cluster, postures)]
    unseen = [cluster.segment for cluster in clusters if cluster not in seen]
    notes += [f"{segment}: none of its markers is seen in a known posture; no answer." for segment in unseen]
    left = _reduced(problem, tuple(seen), postures) if seen else None
    return PreparedProblem(problem=left, segments=segments, frames=len(problem.trajectories), notes=tuple(notes))


def _known(calibration: AnatomicalCalibration) -> Mask:
    """Tell the postures (K, S) in which a bone is known."""
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
