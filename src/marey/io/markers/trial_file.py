"""Reading everything of a marker trial at once: trajectories, force plates, gait events and the vertical axis."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from marey.errors import FileProblem
from marey.io.markers.c3d import open_c3d, point_unit, positions_in, y_points_up
from marey.io.markers.c3d_forces import events_by_person, events_in, force_plates_in
from marey.io.markers.c3d_person import measurements_in, subjects_in
from marey.io.markers.given_angles import angles_in
from marey.io.markers.readers import checked_markers, read_markers
from marey.io.units import METRES, require_unit
from marey.markers.data.force_plates import ForcePlate
from marey.markers.data.given_angles import GivenAngles
from marey.markers.data.person import PersonMeasurements
from marey.markers.data.trajectories import MarkerTrajectories
from marey.motion.events.cycles import GaitEvent


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerFile:
    """The content of one C3D, TRC or CSV of markers."""

    path: Path
    trajectories: MarkerTrajectories
    """All markers, as measured."""
    y_up: bool
    """Whether Y points up in the laboratory; otherwise Z does."""
    plates: tuple[ForcePlate, ...] = ()
    """Force plates; only a C3D has them."""
    events: tuple[GaitEvent, ...] = ()
    """Gait events in the file; only a C3D has them."""
    events_of: Mapping[str, tuple[GaitEvent, ...]] = field(default_factory=dict)
    """The same by the person whose they are; those of nobody are under the empty text."""
    subjects: Mapping[str, str] = field(default_factory=dict)
    """Prefixes of labels that the file states, each with the name of the person; only a C3D has them."""
    name: str = ""
    """Name of the person whose markers were chosen; empty if nobody was."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Maps labels of a person who was chosen to the labels in the file; empty if nobody was chosen."""
    plate_notes: tuple[str, ...] = ()
    """Why the force plates could not be read; empty otherwise."""
    angles: GivenAngles | None = None
    """Angles that another program wrote into the file; only a C3D has them."""
    person: PersonMeasurements = field(default_factory=PersonMeasurements)
    """What the file states of the person; only a C3D does."""
    person_notes: tuple[str, ...] = ()
    """Which of these statements were ignored, one sentence each."""


def read_marker_file(path: Path, *, unit: str | None = None) -> MarkerFile:
    """Read everything that a marker trial needs from its file, which is opened once.

    Force plates that cannot be read are no error, because markers do not need them: `plate_notes` gives the reason.

    Args:
        path: A C3D, TRC or CSV.
        unit: mm, cm or m, if the file states it wrongly or not at all.

    Raises:
        FileProblem: The file cannot be read, or has no markers.
    """
    if not path.is_file():
        raise FileProblem(path, "is a folder" if path.is_dir() else "does not exist", "Give a C3D, TRC or CSV.")
    require_unit(unit)
    if path.suffix.lower() == ".c3d":
        return _read_c3d(path, unit)
    return MarkerFile(path=path, trajectories=read_markers(path, unit=unit), y_up=path.suffix.lower() == ".trc")


def _read_c3d(path: Path, unit: str | None) -> MarkerFile:
    c3d = open_c3d(path)
    y_up, raw = y_points_up(c3d), positions_in(c3d, unit or point_unit(path, c3d))
    person, person_notes = measurements_in(c3d, unit or point_unit(path, c3d))
    plates: tuple[ForcePlate, ...] = ()
    notes: tuple[str, ...] = ()
    try:
        metres = METRES[point_unit(path, c3d)]
        plates = force_plates_in(path, c3d, metres)
    except FileProblem as problem:
        notes = (f"The force plates cannot be read: {problem}",)
    return MarkerFile(
        path=path, y_up=y_up, plates=plates, plate_notes=notes, events=events_in(c3d),
        events_of=events_by_person(c3d), subjects=subjects_in(c3d),
        angles=angles_in(c3d), person=person, person_notes=person_notes, trajectories=checked_markers(path, raw),
    )  # fmt: skip
