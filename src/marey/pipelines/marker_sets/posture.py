"""A posture in which the bones of a person are known by landmarks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from marey.arrays import Floats
from marey.markers.data.person import AssumedMeasurement
from marey.markers.data.trajectories import MarkerTrajectories


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkPosture:
    """Markers of a person in one posture, and the landmarks by which its bones are known."""

    path: Path
    """The file of the posture."""
    name: str
    """What the posture is called in notes."""
    trajectories: MarkerTrajectories
    """The markers; their mean over the frames is used."""
    y_up: bool
    """Whether Y points up in the laboratory; otherwise Z does."""
    landmarks: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Maps landmarks to the markers on them."""
    places: Mapping[str, Floats] = field(default_factory=dict)
    """Maps further landmarks to places (3,) in the laboratory of the posture [m]."""
    notes: tuple[str, ...] = ()
    """How the landmarks were found, one sentence each."""
    assumed: tuple[AssumedMeasurement, ...] = ()
    """Q measurements of the person that are assumed."""
    shifted: tuple[Mapping[str, Floats], ...] = ()
    """Q versions of `places`, each with one of these measurements larger by its standard deviation."""
    remedy: str = "Correct [landmarks]."
    """What to do if a landmark is missing."""
