"""The input of every marker method: a trial's markers, its clusters, and the bones in known postures."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.setup import SkinChoice
from marey.markers.data.trajectories import MarkerTrajectories


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerProblem:
    """The markers of one trial and what is known about the bones beneath them."""

    trajectories: MarkerTrajectories
    """All markers of the trial."""
    clusters: tuple[Cluster, ...]
    """One per segment; only segments that the calibration contains."""
    calibration: AnatomicalCalibration
    """The bones' poses in one frame of the trial, or in several."""
    joints: tuple[tuple[str, str], ...] = ()
    """Pairs (parent, child) of segments connected by a joint."""
    degrees_of_freedom: tuple[int | None, ...] = ()
    """Degrees of freedom of each joint, 1 to 6; None where not specified, empty where none is specified."""
    noise_m: float = 5e-4
    """Standard deviation of a marker's measured coordinate [m]."""
    skin: Mapping[str, SkinChoice] = field(default_factory=dict)
    """Maps a segment to the specified form of its markers' motion over the bone."""
    exercise: "MarkerProblem | None" = None
    """A second trial of the same markers from which their motion over the bones is learned, if there is one."""


class Method(Protocol):
    """A method that estimates bones from markers."""

    def __call__(self, problem: MarkerProblem) -> BoneMotion:
        """Estimate every cluster's bone in every frame; NaN where a frame does not determine it."""
