"""Exercise from which the motion of the skin over the bones is learned."""

from dataclasses import replace

from marey.errors import FileProblem, MareyError
from marey.io.markers.setup import read_reference
from marey.markers.data.clusters import MINIMUM_MARKERS, AnatomicalCalibration
from marey.markers.data.problem import MarkerProblem
from marey.markers.preprocessing.own_frames import BonesAndMarkers, transfer_calibration
from marey.pipelines.marker_sets.chosen_person import read_markers_of
from marey.pipelines.markers.settings import MarkerSettings


def read_exercise(problem: MarkerProblem, settings: MarkerSettings) -> tuple[MarkerProblem, tuple[str, ...]]:
    """Read the exercise, and add it to the problem.

    The poses of its bones come from its own reference, or are transferred from the trial by the shared markers.

    Args:
        problem: The problem of the trial.
        settings: Name the exercise and its reference.

    Returns:
        The problem with the exercise, and notes.

    Raises:
        FileProblem: The exercise has other markers than the trial, or its reference cannot be used.
    """
    assert settings.exercise is not None
    trial = read_markers_of(settings.exercise, person=settings.person, unit=settings.unit)
    clusters = tuple(
        replace(cluster, labels=tuple(label for label in cluster.labels if label in trial.labels))
        for cluster in problem.clusters
    )
    clusters = tuple(cluster for cluster in clusters if len(cluster.labels) >= MINIMUM_MARKERS)
    calibration: AnatomicalCalibration
    if settings.exercise_reference is not None:
        segments = tuple(cluster.segment for cluster in clusters)
        calibration, notes = read_reference(settings.exercise_reference, segments, frames=len(trial))
    else:
        try:
            moved = transfer_calibration(_posture(problem), trial, clusters)
        except MareyError as fault:
            raise FileProblem(settings.exercise, f"does not fit the trial: {fault}".rstrip(".")) from None
        calibration, notes = moved.calibration, moved.notes
    kept = tuple(cluster for cluster in clusters if cluster.segment in calibration.segments)
    joints = tuple(pair for pair in problem.joints if set(pair) <= set(calibration.segments))
    exercise = MarkerProblem(
        trajectories=trial, clusters=kept, calibration=calibration, joints=joints, noise_m=problem.noise_m
    )
    return replace(problem, exercise=exercise), tuple(f"{settings.exercise.name}: {note}" for note in notes)


def _posture(problem: MarkerProblem) -> BonesAndMarkers:
    """Return the bones and markers of the trial in the first frame with known poses."""
    calibration, trial = problem.calibration, problem.trajectories
    return BonesAndMarkers(
        segments=calibration.segments, rotation=calibration.rotation[0], origin=calibration.origin[0],
        labels=trial.labels, points=trial.points[calibration.frames[0]],
    )  # fmt: skip
