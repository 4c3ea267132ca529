"""User settings for markers: the markers of each segment, anatomical landmarks, joints, and skin motion."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from marey.arrays import Floats
from marey.markers.data.person import PersonMeasurements


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerJoint:
    """A joint between two segments."""

    name: str
    parent: str
    child: str
    degrees_of_freedom: int | None = None
    """1 for a hinge, 3 for a ball joint, 6 for an unconstrained joint; None if not specified."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinChoice:
    """Form of the motion of one segment's markers over the bone, for interval deformation."""

    form: str
    """`constant`, `time`, `rotation`, `sinusoid`, `spline`, or `file`."""
    period_s: float | None = None
    """Period of a sinusoid [s]; None to derive it from the joint's motion."""
    pieces: int | None = None
    """Number of spline pieces; None for the default."""
    functions: Floats | None = None
    """(F, Q) user-defined functions of time, for `file`."""
    still: tuple[str, ...] = ()
    """Markers that do not move over the bone."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Pointer:
    """A pointer whose tip showed landmarks, each in a trial of its own."""

    markers: tuple[str, ...]
    """Labels of its markers; the last one is nearest to the tip if they are in a line with it."""
    tip_m: float | None = None
    """Distance of the tip from the last marker, on the line from the first to the last [m]; None with a pivot trial."""
    pivot: Path | None = None
    """Trial in which the pointer was turned about its resting tip; None with a distance."""
    trials: Mapping[str, Path] = field(default_factory=dict)
    """Maps each landmark to the trial in which the tip is on it."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All trials of the pointer."""
        return (*(() if self.pivot is None else (self.pivot,)), *self.trials.values())


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerSetup:
    """Contents of the marker settings file; every entry is optional."""

    segments: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Maps a segment to the labels of its markers (or patterns such as `LF*`); empty to derive clusters from labels."""
    landmarks: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Maps an anatomical landmark (`left_LE`) to the marker placed on it, or to several whose midpoint it is."""
    joints: tuple[MarkerJoint, ...] = ()
    noise_m: float | None = None
    """Standard deviation of a marker's measured coordinate [m]; None if not specified."""
    skin: Mapping[str, SkinChoice] = field(default_factory=dict)
    """Maps a segment to the form of its skin motion; for other segments an information criterion chooses the form."""
    person: PersonMeasurements = field(default_factory=PersonMeasurements)
    """Measurements of the person, for trials with a known marker set."""
    pointer: Pointer | None = None
    """A pointer that showed landmarks; None without one."""
