"""The record of an estimated motion of bones."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.io.opensim.mot_sto import TimeSeriesTable
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.given_angles import GivenAngles
from marey.markers.data.marker_motion import MarkerMotion
from marey.markers.kinematics.calibration_offsets import AngleOffset
from marey.markers.kinematics.given_agreement import GivenAgreement, compare_given_angles
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.landmark_motion import LandmarkMotion
from marey.motion.events.repetitions import Repetitions
from marey.pipelines.gait.walk import Gait
from marey.pipelines.markers.trial import MarkerTrial
from marey.pipelines.run_details import RunDetails
from marey.pipelines.verdict import Verdict


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodRun:
    """The result of one method."""

    name: str
    """Name of the method in `METHODS`, or `model`."""
    summary: str
    """What the method does, in one line."""
    motion: BoneMotion
    """Poses of the bones."""
    joints: JointKinematics
    """Joint angles and translations; without names if they were not read."""
    markers: MarkerMotion
    """Motion of the markers relative to the bones; without labels if it was not read."""
    seconds: float
    """Computing time [s], of the run in which the result was computed."""
    offsets: tuple[AngleOffset, ...] = ()
    """What assumed measurements of the person contribute to the standard deviations of the joint angles; none if they
    were not read."""
    landmarks: LandmarkMotion = field(default_factory=LandmarkMotion)
    """Paths of the landmarks of a static trial; none without one, or if they were not read."""
    table: TimeSeriesTable | None = None
    """All coordinates of an OpenSim model; None for other methods."""
    fit: str = ""
    """Distance between the markers and an OpenSim model, in one line; empty for other methods."""
    model_rms_m: float = float("nan")
    """Root mean square distance between the markers and an OpenSim model [m]; NaN for other methods."""
    undetermined: tuple[str, ...] = ()
    """Coordinates of an OpenSim model that the markers do not determine."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class EstimatedBones:
    """The motion of the bones beneath the markers of a trial, by one method or several."""

    runs: tuple[MethodRun, ...]
    """One result per method; all properties are those of the first one."""
    time: Floats
    """(F,) time of each frame [s]."""
    frames: Mask
    """(F,) true for the frames that were to be estimated."""
    gait: Gait
    """Gait events and cycles; empty if there are none."""
    repetitions: Repetitions = field(default_factory=Repetitions)
    """Squats, sitting down and standing up, and jumps; none of a walk, or without markers of both feet."""
    anatomical: bool
    """Whether the bones' frames are anatomical; otherwise they are the clusters' principal axes."""
    side: str | None = None
    """`left` or `right`, if it is known and the names of the segments do not contain it."""
    reference_frames: Integers | None = None
    """(K,) frames in which the poses of the bones were known; None for a model."""
    given_angles: GivenAngles | None = None
    """Angles that another program wrote into the file of the trial, in all of its frames; None if there are none."""
    details: RunDetails
    """Settings, inputs, warnings and times of the run."""
    trial: MarkerTrial | None = None
    """The trial; None for a result that was read from a folder."""
    folder: Path | None = None
    """The folder from which the result was read."""

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods."""
        return tuple(run.name for run in self.runs)

    @property
    def coordinates(self) -> TimeSeriesTable | None:
        """All coordinates of an OpenSim model; None without a model."""
        return self.runs[0].table

    @property
    def motion(self) -> BoneMotion:
        """Poses of the bones with their covariances."""
        return self.runs[0].motion

    @property
    def joints(self) -> JointKinematics:
        """Joint angles [rad] and translations [m] with standard deviations."""
        return self.runs[0].joints

    @property
    def given_agreement(self) -> tuple[GivenAgreement, ...]:
        """Agreement of the joint angles with those of another program in the file of the trial, for each angle in both.

        Empty without an anatomical calibration.
        """
        if self.given_angles is None or not self.anatomical:
            return ()
        return compare_given_angles(self.joints, self.given_angles, self.frames)

    @property
    def markers(self) -> MarkerMotion:
        """Positions of the markers in the frames of their bones [m]."""
        return self.runs[0].markers

    @property
    def segments(self) -> tuple[str, ...]:
        """Names of the S bones."""
        return self.motion.segments

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]; NaN for a single frame."""
        return 1 / float(np.median(np.diff(self.time))) if len(self.time) > 1 else float("nan")

    @property
    def verdict(self) -> Verdict | None:
        """How far the result can be used, and what limits it; None for a result of an earlier version."""
        return self.details.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the run, one sentence each."""
        return self.details.warnings
