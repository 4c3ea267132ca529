"""What is found in a calibration session, and what its examination uses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from marey.arrays import Integers
from marey.calibration.adjustment.landmarks import LandmarkWorld
from marey.calibration.adjustment.solve import SolvedSession
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.causes import Cause
from marey.calibration.quality.views import CameraQuality, ViewQuality
from marey.calibration.timing.wand_clocks import StatedDelay
from marey.wording import count_of, listed

Severity = Literal["problem", "caution", "note"]
"""Whether the result is wrong, less accurate than it could be, or only remarkable."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something that is wrong, or could be better."""

    code: str
    """Name for programs, for example `camera-moved`."""
    severity: Severity
    text: str
    """What was found, as a sentence."""
    advice: str
    """What to do or to film next, as a sentence."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Examined:
    """Everything that the examination of a session uses."""

    solved: SolvedSession
    corners: CornerSet
    """All corners that were measured, also those that were left out."""
    views: ViewQuality
    cameras: tuple[CameraQuality, ...]
    floor: bool
    """Whether the floor is known: from the board on it, or from points with known coordinates."""
    together: bool
    """Whether the cameras recorded at the same time."""
    distances: Mapping[tuple[str, str], float]
    """Known distances between cameras by their names [m]."""
    landmarks: LandmarkWorld | None = None
    """The world of points with known coordinates; None if there are none."""
    late: Mapping[str, int] = field(default_factory=dict)
    """By how many pictures cameras recorded everything too late, by name; it was allowed for."""
    delays: tuple[StatedDelay, ...] = ()
    """Delays of cameras that were estimated with a wand; empty if none were."""
    rate: float | None = None
    """Pictures per second that were used of the videos [Hz]; None for single pictures."""
    cause: Cause | None = None
    """Why one camera contradicts the others, if that was found."""
    further: tuple[Cause, ...] = ()
    """Why more cameras do: clocks that were found with a wand, too, and allowed for."""
    still: Integers | None = None
    """(F,) the first picture of the run of still pictures that each belongs to, whose corners were joined there."""

    @property
    def causes(self) -> tuple[Cause, ...]:
        """Why cameras contradict the others."""
        return () if self.cause is None else (self.cause, *self.further)


def left_out_text(pictures: int, views: int) -> str:
    """Return how much was left out of a session, in words.

    Args:
        pictures: Number of pictures that were left out in all cameras.
        views: Number of further pictures, each of one camera.
    """
    parts = [f"{count_of(pictures, 'picture')} of all cameras"] if pictures else []
    parts += [f"{count_of(views, 'picture')} of single cameras"] if views else []
    return " and ".join(parts)


def camera_names(session: Examined, cameras: Sequence[int] | Integers) -> str:
    """Return the names of cameras as a list in words."""
    return listed([session.corners.cameras[int(camera)] for camera in cameras])


def picture_names(session: Examined, pictures: Sequence[int] | Integers) -> str:
    """Return the names of pictures, up to six, as a list in words."""
    return listed([session.corners.pictures[int(picture)] for picture in pictures], most=6)
