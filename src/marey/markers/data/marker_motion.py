"""Motion of markers relative to the bones beneath them, derived from an estimated motion of the bones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerMotion:
    """The positions of M markers in the frames of their bones, over F frames."""

    labels: tuple[str, ...]
    """M labels."""
    segments: tuple[str, ...]
    """(M,) the bone of each marker."""
    places: Floats
    """(F, M, 3) position in the bone's frame [m]; NaN where the marker or the bone is missing."""

    def __post_init__(self) -> None:
        freeze_fields(self, "places")

    @property
    def moved(self) -> Floats:
        """(F, M, 3) displacement from each marker's mean position over the trial [m]."""
        known = np.isfinite(self.places)
        counts = np.maximum(known.sum(0), 1)
        return np.asarray(self.places - np.where(known, self.places, 0.0).sum(0) / counts)

    @property
    def rms(self) -> Floats:
        """(M,) root mean square distance from the mean position [m]; NaN for a marker that is never visible."""
        squares = (self.moved**2).sum(-1)
        known = np.isfinite(squares)
        total = np.where(known, squares, 0.0).sum(0)
        return np.where(known.any(0), np.sqrt(total / np.maximum(known.sum(0), 1)), np.nan)

    def of(self, segment: str) -> Floats:
        """Return the root mean square distance (F,) of one segment's markers from their mean positions [m]."""
        squares = (self.moved[:, [s == segment for s in self.segments]] ** 2).sum(-1)
        known = np.isfinite(squares)
        total = np.where(known, squares, 0.0).sum(1)
        return np.where(known.any(1), np.sqrt(total / np.maximum(known.sum(1), 1)), np.nan)


def marker_motion(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], motion: BoneMotion
) -> MarkerMotion:  # fmt: skip
    """Express markers in the frames of their bones.

    Args:
        trajectories: Marker trajectories of the trial.
        clusters: The markers of each bone; clusters whose bone has no motion are left out.
        motion: Motion of the bones.
    """
    labels: list[str] = []
    segments: list[str] = []
    places: list[Floats] = []
    for cluster in clusters:
        if cluster.segment in motion.segments and cluster.labels:
            rotation, origin = motion.bone(cluster.segment)
            points = trajectories.select(cluster.labels).points
            places.append(np.einsum("fji,fmj->fmi", rotation, points - origin[:, None]))
            labels.extend(cluster.labels)
            segments.extend([cluster.segment] * len(cluster.labels))
    shape = (len(trajectories), 0, 3)
    return MarkerMotion(
        labels=tuple(labels), segments=tuple(segments),
        places=np.concatenate(places, 1) if places else np.zeros(shape),
    )  # fmt: skip
