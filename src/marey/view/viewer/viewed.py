"""What the page of `marey view` shows: one or two results over time, and the videos of their trial."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.body.articulation.surface import Body
from marey.cameras.rig import Rig
from marey.io.video.video import Clip
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import MarkerMotion
from marey.motion.events.cycles import GaitEvent
from marey.motion.motion import BodyMotion
from marey.view.pages.marker_scene import MarkerPaths


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewedBody:
    """A captured motion, and the person's body at rest."""

    motion: BodyMotion
    """The F frames of the page."""
    body: Body | None
    """None shows the joints alone."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewedMarkers:
    """Markers and the bones beneath them, over the F frames of the page."""

    paths: MarkerPaths
    motion: BoneMotion
    markers: MarkerMotion


@dataclass(frozen=True, eq=False, kw_only=True)
class PlateForce:
    """The force of a plate in the F frames of the page."""

    name: str
    corners: Floats
    """(4, 3) in the laboratory [m]."""
    at: Floats
    """(F, 3) centre of pressure in the laboratory [m]; NaN without load."""
    force: Floats
    """(F, 3) force on the person, in the laboratory [N]."""
    vertical: Floats
    """(F,) force perpendicular to the plate [N]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "corners", "at", "force", "vertical")


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewedResult:
    """One result of `marey capture`, `marey shape` or `marey markers`."""

    name: str
    """Name of its folder."""
    time: Floats
    """(F,) time of each frame [s]."""
    first: int
    """Number of the first frame."""
    state: Integers
    """(F,) 0 no person, 1 measured, 2 filled, 3 lost."""
    angle_names: tuple[str, ...]
    """A names."""
    angles_deg: Floats
    """(F, A) [degrees]."""
    angles_deg_sd: Floats
    """(F, A) standard deviations [degrees]; NaN where unknown."""
    shown: ViewedBody | ViewedMarkers
    """What the 3-D view shows."""
    angles_determined: Mask | None = None
    """(F, A) where the images determine an angle; None where that is not known."""
    forces: Sequence[PlateForce] = ()
    events: Sequence[GaitEvent] = ()
    level: str = ""
    """The level of the verdict; empty without one."""
    reasons: Sequence[str] = ()
    """Reasons of the verdict."""
    report: bytes | None = field(default=None, repr=False)
    """The report page of the run; None if there is none."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time", "angles_deg", "angles_deg_sd")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def rate(self) -> float:
        """Frames per second [Hz]; 1 for a single frame."""
        return (len(self) - 1) / float(self.time[-1] - self.time[0]) if len(self) > 1 else 1.0

    def rows_at(self, time: Floats) -> Integers:
        """Return the frames nearest to times (N,) [s]; -1 more than a frame before the first or after the last one."""
        after = np.clip(np.searchsorted(self.time, time), 1, max(len(self) - 1, 1))
        before = after - 1
        last = np.minimum(after, len(self) - 1)
        nearest = np.where(time - self.time[before] <= self.time[last] - time, before, last)
        away = np.abs(self.time[nearest] - time)
        return np.where(away <= 1.0 / self.rate, nearest, -1).astype(np.int32)


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewedTake:
    """The videos of the trial: frame i of the first result is picture `first` + i of every clip."""

    rig: Rig
    """The cameras."""
    clips: Sequence[Clip]
    """One clip per camera."""
    copies: Path | None = None
    """Folder for copies of the videos in which every frame is reached quickly; None to make none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewerContent:
    """Content of the page: its time is that of the first result."""

    results: Sequence[ViewedResult]
    """One or two."""
    take: ViewedTake | None = None
    """None without videos."""
    without_videos: str = ""
    """Why there are no videos, in one sentence."""
    same_room: bool = False
    """Whether both results are in one world, so that the second can be shown over the first."""
