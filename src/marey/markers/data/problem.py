"""What every method of the room is given: a trial's markers, its clusters, and where the bones were once."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.setup import SkinChoice
from marey.markers.data.trajectories import MarkerTrajectories


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerProblem:
    """The markers of one trial and what is known of the bones beneath them."""

    trajectories: MarkerTrajectories
    """All markers of the trial."""
    clusters: tuple[Cluster, ...]
    """One a segment; only segments that the calibration knows."""
    calibration: AnatomicalCalibration
    """The bones' poses in one frame of the trial, or in several."""
    joints: tuple[tuple[str, str], ...] = ()
    """Pairs (parent, child) of segments that a joint ties together."""
    degrees_of_freedom: tuple[int | None, ...] = ()
    """Of each joint, 1 to 6, None where it is not said; empty where nothing is said of any."""
    noise_m: float = 5e-4
    """Standard deviation of a marker's measured coordinate [m]."""
    skin: Mapping[str, SkinChoice] = field(default_factory=dict)
    """Segment to how its markers are said to move over the bone."""
    exercise: "MarkerProblem | None" = None
    """A second trial of the same markers in which their motion over the bones is learned, where there is one."""


class Method(Protocol):
    """One way from markers to bones."""

    def __call__(self, problem: MarkerProblem) -> BoneMotion:
        """Estimate every cluster's bone in every frame; NaN where the frame has no answer."""
