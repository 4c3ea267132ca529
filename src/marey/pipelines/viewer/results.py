"""Reading of results for the page of `marey view`: captured motions, and bones from markers."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.activity import laboratory_is_y_up
from marey.io.markers.recordings import find_motion_file, read_recording
from marey.io.markers.trial_file import MarkerFile
from marey.io.pages import read_page
from marey.markers.data.force_plates import ForcePlate
from marey.motion.motion import MEASURED
from marey.motion.recording import Recording
from marey.pipelines.capture.motion import Motion, load_motion
from marey.pipelines.marker_sets.chosen_person import read_file_of
from marey.pipelines.markers.bones import Bones, load_bones
from marey.pipelines.run_record import record_of
from marey.pipelines.same_names import same_names
from marey.pipelines.verdict import Verdict
from marey.view.pages.html import span_of
from marey.view.pages.marker_scene import MarkerPaths
from marey.view.viewer.viewed import PlateForce, ViewedBody, ViewedMarkers, ViewedResult


def read_viewed(folder: Path) -> ViewedResult:
    """Read the result in a folder.

    Args:
        folder: Folder with `motion.npz` or `bones.npz`, or the trial whose results are in `marey/`.

    Returns:
        The frames that were requested.

    Raises:
        FileProblem: There is no such result, or a file of it cannot be used.
    """
    file = find_motion_file(folder)
    if file.name == "bones.npz":
        return _of_markers(file.parent)
    return _of_capture(file)


def with_same_names(first: ViewedResult, second: ViewedResult) -> tuple[ViewedResult, ViewedResult]:
    """Return two results whose equal angles have equal names; see `same_names`.

    Args:
        first: A result.
        second: Another one.
    """
    renamed = same_names(_angles(first), _angles(second), {})
    return _renamed(first, renamed[0]), _renamed(second, renamed[1])


def shifted(result: ViewedResult, seconds: float) -> ViewedResult:
    """Return a result whose times and events are later.

    Args:
        result: The result.
        seconds: Added to all times [s].
    """
    events = [replace(event, time=event.time + seconds) for event in result.events]
    return replace(result, time=result.time + seconds, events=events)


def _angles(result: ViewedResult) -> Recording:
    return Recording(
        time=result.time, angle_names=result.angle_names, angles=np.radians(result.angles_deg),
        angles_sd=np.radians(result.angles_deg_sd),
    )  # fmt: skip


def _renamed(result: ViewedResult, angles: Recording) -> ViewedResult:
    return replace(
        result, angle_names=angles.angle_names, angles_deg=np.degrees(angles.angles),
        angles_deg_sd=np.degrees(angles.angles_sd),
    )  # fmt: skip


def _of_capture(file: Path) -> ViewedResult:
    motion = load_motion(file)
    requested = np.array([flag != "not selected" for flag in motion.flags])
    shown = span_of(requested)
    data = motion.data.frames(shown)
    body, events = _body_and_events(motion)
    return ViewedResult(
        name=_name(file.parent), time=data.time, first=shown.start or 0, state=data.state,
        angle_names=data.angle_names, angles_deg=data.angles_deg, angles_deg_sd=data.angles_deg_sd,
        angles_determined=data.angles_determined, shown=ViewedBody(motion=data, body=body),
        events=_within(events, data.time), **_of_run(file),
    )  # fmt: skip


def _body_and_events(motion: Motion) -> tuple[Any, tuple[Any, ...]]:
    """Return the body and the gait events of a captured motion; none without a body.npz beside it."""
    if motion.folder is None or not (motion.folder / "body.npz").is_file():
        return None, ()
    return motion.body, motion.events


def _of_markers(folder: Path) -> ViewedResult:
    bones = load_bones(folder)
    shown = span_of(bones.frames)
    recording = read_recording(folder / "bones.npz")
    file, y_up = _marker_file(folder, bones), laboratory_is_y_up(folder)
    points = file.trajectories.points[shown]
    paths = MarkerPaths(
        labels=file.trajectories.labels, points=points, filled=file.trajectories.filled[shown],
        upright=OPENSIM_FROM_WORLD.T if y_up else np.eye(3),
    )  # fmt: skip
    whole, time = bones.motion, bones.time[shown]
    motion = replace(
        whole, rotation=whole.rotation[shown], origin=whole.origin[shown], covariance=whole.covariance[shown]
    )  # fmt: skip
    return ViewedResult(
        name=_name(folder), time=time, first=shown.start or 0,
        state=np.where(motion.answered.any(1), MEASURED, 0).astype(np.uint8),
        angle_names=recording.angle_names, angles_deg=np.degrees(recording.angles[shown]),
        angles_deg_sd=np.degrees(recording.angles_sd[shown]),
        shown=ViewedMarkers(paths=paths, motion=motion, markers=bones.markers),
        forces=[_plate_force(plate, time, float(bones.time[0])) for plate in file.plates],
        events=_within(bones.gait.events or file.events, time), **_of_run(folder / "bones.npz"),
    )  # fmt: skip


def _marker_file(folder: Path, bones: Bones) -> MarkerFile:
    """Read the markers of a run from its motion.c3d.

    Raises:
        FileProblem: There is no such file, or it has another number of frames.
    """
    path = folder / "motion.c3d"
    if not path.is_file():
        raise FileProblem(folder, "has no motion.c3d beside bones.npz", "Run marey markers again.")
    person = bones.details.settings.get("person")
    file = read_file_of(path, None if person is None else str(person), required=False)
    if len(file.trajectories.points) != len(bones.time):
        wrong = f"has {len(file.trajectories.points)} frames, but bones.npz {len(bones.time)}"
        raise FileProblem(path, wrong, "Run marey markers again.")
    return file


def _plate_force(plate: ForcePlate, time: Floats, start: float) -> PlateForce:
    """Return the force of a plate at times [s]; its samples begin at `start`."""
    samples = np.rint((time - start) * plate.rate).astype(int)
    known = (samples >= 0) & (samples < len(plate.force))
    at, force, vertical = (np.full((len(time), *shape), np.nan) for shape in ((3,), (3,), ()))
    at[known] = plate.centre_of_pressure[samples[known]]
    force[known], vertical[known] = plate.force[samples[known]], plate.vertical[samples[known]]
    return PlateForce(name=plate.name, corners=plate.corners, at=at, force=force, vertical=vertical)


def _within(events: tuple[Any, ...], time: Floats) -> list[Any]:
    return [event for event in events if time[0] <= event.time <= time[-1]] if len(time) else []


def _name(folder: Path) -> str:
    """Return the name of a result: that of its folder, or of the trial for `TRIAL/marey`."""
    folder = folder.resolve()
    return folder.parent.name if folder.name == "marey" else folder.name


def _of_run(file: Path) -> dict[str, Any]:
    """Return the verdict and the report of the run that wrote a file."""
    record = record_of(file.parent, file.name)
    verdict = Verdict.from_record(record)
    level, reasons = ("", []) if verdict is None else verdict.texts()
    return {"level": level, "reasons": tuple(reasons), "report": read_page(file.parent / "report.html")}
