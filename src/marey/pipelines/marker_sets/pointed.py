"""Landmarks that the tip of a pointer showed in trials of their own, as further points of a posture."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.markers.trial_file import MarkerFile
from marey.markers.data.clusters import MINIMUM_MARKERS
from marey.markers.data.setup import Pointer
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.landmark_motion import bearer_of
from marey.markers.preprocessing.functional import transfer_point
from marey.markers.preprocessing.pointer import pointed_place, tip_by_pivot, tip_of_shape, tip_on_line
from marey.wording import listed


@dataclass(frozen=True, eq=False, kw_only=True)
class PointedLandmarks:
    """A posture with landmarks that a pointer showed."""

    file: MarkerFile
    """The file of the posture, with a point for each landmark under its name."""
    notes: tuple[str, ...]
    """How the landmarks were found, one sentence each."""


Reader = Callable[[Path], MarkerTrajectories]
"""Reads the markers of a person from a file."""


def with_pointed_landmarks(
    file: MarkerFile, pointer: Pointer, segments: Mapping[str, Sequence[str]], read: Reader
) -> PointedLandmarks:
    """Transfer landmarks from trials with a pointer to a posture, by the markers of their segments.

    Args:
        file: The file of the posture.
        pointer: The pointer and its trials.
        segments: Maps segments to the labels of their markers.
        read: Reads the trials.

    Raises:
        FileProblem: A trial cannot be used, lacks markers, or shows no place that rests on the segment; a landmark is
            on none of the segments.
    """
    tip, notes = _tip(pointer, read)
    paths: dict[str, Floats] = {}
    for name, path in pointer.trials.items():
        segment = bearer_of(name, tuple(segments))
        if segment is None:
            wrong = f"shows the landmark {name} of [pointer.trials], which is on none of the segments"
            raise FileProblem(path, wrong, f"The segments are {listed(segments)}.")
        trial = read(path)
        labels = [label for label in segments[segment] if label in trial.labels and label in file.trajectories.labels]
        if len(labels) < MINIMUM_MARKERS:
            wrong = f"has fewer than {MINIMUM_MARKERS} markers of {segment} in common with {file.path.name}"
            raise FileProblem(path, wrong, f"{name} is carried by {segment}: its markers must be visible.")
        try:
            found = pointed_place(trial.select(labels).points, tip(path, trial))
        except MareyError as problem:
            raise _as_file_problem(path, f"does not show {name}", problem) from None
        paths[name] = transfer_point(found.shape, found.place, file.trajectories.select(labels).points)
        if not np.isfinite(paths[name]).all(-1).any():
            wrong = f"has no frame with {MINIMUM_MARKERS} markers of {segment}, which carries {name}"
            raise FileProblem(file.path, wrong)
        moved = f"{1e3 * found.motion_m:.1f} mm (RMS) relative to {segment}"
        notes.append(f"{name} is where the pointer rests in {path.name}; its tip moves by {moved}.")
    return PointedLandmarks(
        file=replace(file, trajectories=file.trajectories.with_points(paths)), notes=tuple(notes)
    )  # fmt: skip


def _tip(pointer: Pointer, read: Reader) -> tuple[Callable[[Path, MarkerTrajectories], Floats], list[str]]:
    """Return a function of a trial and its file that gives the path of the tip, and notes."""
    if pointer.pivot is None:
        assert pointer.tip_m is not None
        distance = pointer.tip_m
        return lambda path, trial: tip_on_line(_of_pointer(path, trial, pointer), distance), []
    try:
        found = tip_by_pivot(_of_pointer(pointer.pivot, read(pointer.pivot), pointer))
    except MareyError as problem:
        raise _as_file_problem(pointer.pivot, "does not determine the tip of the pointer", problem) from None
    rests = f"where it rests within {1e3 * found.residual_m:.1f} mm (RMS)"
    note = f"The tip of the pointer is known from {pointer.pivot.name}, {rests}."
    return lambda path, trial: tip_of_shape(_of_pointer(path, trial, pointer), found), [note]


def _of_pointer(path: Path, trial: MarkerTrajectories, pointer: Pointer) -> Floats:
    """Return the markers (F, M, 3) of the pointer in a trial.

    Raises:
        FileProblem: One is missing.
    """
    missing = [label for label in pointer.markers if label not in trial.labels]
    if missing:
        remedy = f"Correct [pointer] markers; the trial has {listed(trial.labels, most=12)}."
        raise FileProblem(path, f"lacks the markers {listed(missing)} of the pointer", remedy)
    return trial.select(pointer.markers).points


def _as_file_problem(path: Path, wrong: str, problem: MareyError) -> MareyError:
    """Name the file in an error, unless it is named already."""
    if isinstance(problem, FileProblem):
        return problem
    return FileProblem(path, f"{wrong} ({str(problem).rstrip('.')})")
