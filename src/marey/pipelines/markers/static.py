"""What other trials tell of the one that is followed: bones in a static trial, joint centres, skin in an exercise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.markers.readers import read_markers
from marey.io.markers.setup import read_reference
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.labels import clusters_from_names, find_clusters
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import fit_rigid
from marey.markers.data.setup import MarkerSetup
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import usual_joints
from marey.markers.preprocessing.exchanges import exchanges_against_posture
from marey.markers.preprocessing.functional import FunctionalCentre, score, transfer_point
from marey.markers.preprocessing.landmarks import static_bones
from marey.markers.preprocessing.own_frames import BonesAndMarkers, TransferredCalibration, transfer_calibration
from marey.pipelines.markers.settings import MarkersOptions

LANDMARK_SD_M = 5e-3
"""Standard deviation of a palpated landmark's coordinate [m]: some millimetres from one examiner to the other."""
CENTRES = {"thigh": "HJC", "upperarm": "GH"}
"""Landmarks that are centres of joints, by the kind of the segment that turns about them."""
_SIDES = ("left_", "right_")
_ACROSS = (("KJC", "LE", "ME"), ("AJC", "LM", "MM"), ("EJC", "EL", "EM"), ("WJC", "RS", "US"))
"""Centre, lateral and medial landmark of joints."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StaticBones:
    """The bones as a static trial gives them, carried into the trial."""

    carried: TransferredCalibration
    notes: tuple[str, ...]


def from_static(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], setup: MarkerSetup, options: MarkersOptions
) -> StaticBones:
    """Find the bones by the landmarks of a static trial and carry them into the trial.

    Args:
        trajectories: Of the trial.
        clusters: Of the trial.
        setup: Names the landmarks.
        options: Names the static trial, and functional ones.

    Raises:
        FileProblem: No landmark is named, or one is not there; no bone can be made, or carried.
    """
    assert options.static is not None
    if not setup.landmarks:
        place = options.setup or options.static
        raise FileProblem(
            place, "names no landmarks, without which a static trial tells no bones",
            'Write [landmarks] left_LE = "LKNE", ... into the TOML given with --clusters.',
        )  # fmt: skip
    static = read_markers(options.static, unit=options.unit)
    further, notes = functional_centres(static, setup, options)
    try:
        mirrored, said = across_centres(static, setup.landmarks)
        further, notes = {**mirrored, **further}, [*notes, *said]
        bones, found = static_bones(
            static, clusters, setup.landmarks, landmark_sd_m=LANDMARK_SD_M, side=options.side, further=further
        )
    except MareyError as problem:
        raise FileProblem(
            options.static, f"lacks a landmark ({str(problem).rstrip('.')})", "Mend [landmarks]."
        ) from None
    if not found.frames:
        raise FileProblem(options.static, f"gives no bone: {' '.join(found.notes)}".rstrip("."), "Add landmarks.")
    turns = [float(np.degrees(np.sqrt(np.diag(f.covariance)[:3].max()))) for f in found.frames]
    told = ", ".join(f"{f.segment} {turn:.1f}" for f, turn in zip(found.frames, turns, strict=True))
    notes += [
        f"Bones from the landmarks of {options.static.name}. If these are palpated to {1e3 * LANDMARK_SD_M:.0f} mm, "
        f"a bone's axes are known to (degrees): {told}. This error is constant and is in no stated deviation."
    ]
    try:
        moved = transfer_calibration(bones, trajectories, clusters)
    except MareyError as problem:
        raise FileProblem(options.static, f"does not fit the trial: {problem}".rstrip(".")) from None
    notes += [*found.notes, *moved.notes, _carried_text(moved)]
    notes += [
        f"Against {options.static.name}, {exchange.note}"
        for exchange in exchanges_against_posture(trajectories, clusters, bones.labels, bones.points)
    ]
    return StaticBones(carried=moved, notes=tuple(notes))


def across_centres(
    static: MarkerTrajectories, landmarks: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Floats], list[str]]:
    """Put missing medial landmarks across the joint's centre from the lateral ones.

    Many marker sets palpate the lateral side only and tell the joint's centre (`left_KJC`, `left_AJC`).

    Args:
        static: The static trial.
        landmarks: As the TOML names them.

    Returns:
        Landmark to place (3,) in the static trial's laboratory [m], and what was done.

    Raises:
        MareyError: A landmark names a marker that is not there.
    """
    places: dict[str, Floats] = {}
    notes: list[str] = []
    for side in ("", *_SIDES):
        for centre, lateral, medial in _ACROSS:
            names = [f"{side}{name}" for name in (centre, lateral, medial)]
            if names[0] in landmarks and names[1] in landmarks and names[2] not in landmarks:
                middle, outer = (_mean_place(static, landmarks[name]) for name in names[:2])
                places[names[2]] = 2 * middle - outer
                notes.append(f"{names[2]} is taken across {names[0]} from {names[1]}.")
    return places, notes


def _mean_place(static: MarkerTrajectories, labels: Sequence[str]) -> Floats:
    """Give the mean place (3,) of one marker, or of the middle of several; NaN where one is never there."""
    points = static.select(labels).points
    known = np.isfinite(points)
    total = np.where(known, points, 0.0).sum(0)
    counts = np.maximum(known.sum(0), 1)
    return np.asarray(np.where(known.any(0), total / counts, np.nan).mean(0))


def _carried_text(moved: TransferredCalibration) -> str:
    frame = int(moved.calibration.frames[0])
    each = ", ".join(
        f"{name} {1e3 * off:.1f}" for name, off in zip(moved.calibration.segments, moved.residual_m, strict=True)
    )
    return f"Frame {frame} looks most as the static trial; its markers lie from theirs by (mm, RMS): {each}."


def functional_centres(
    static: MarkerTrajectories, setup: MarkerSetup, options: MarkersOptions
) -> tuple[dict[str, Floats], list[str]]:
    """Find joint centres from trials in which a joint was moved about, and carry them into the static trial.

    Of each functional trial the joint is taken whose bones turn most against each other.

    Args:
        static: Into which the centres are carried by the parent's markers.
        setup: Names the segments.
        options: Names the trials.

    Returns:
        Landmark to place (3,) in the static trial's laboratory, and what was found.

    Raises:
        FileProblem: A trial shows no such joint, or the static one not the markers above it.
    """
    places, notes = {}, []
    for path in options.functional:
        trial = read_markers(path, unit=options.unit)
        parent, child = _moved_joint(path, trial, setup)
        try:
            found = score(trial.select(parent.labels).points, trial.select(child.labels).points)
        except MareyError as problem:
            raise FileProblem(path, f"does not tell the joint's centre ({str(problem).rstrip('.')})") from None
        name = _centre_name(child.segment)
        places[name] = _in_static(found, parent, static, path)
        sd = 1e3 * float(np.sqrt(np.diag(found.covariance).max()))
        notes.append(
            f"{name} is the centre about which {child.segment} turns on {parent.segment} in {path.name}: known to "
            f"{sd:.1f} mm, the two bones' centres {1e3 * found.residual:.1f} mm apart (RMS)."
        )
    return places, notes


def _moved_joint(path: Path, trial: MarkerTrajectories, setup: MarkerSetup) -> tuple[Cluster, Cluster]:
    """Find the joint of a functional trial: among those with a centre, the one that turns most."""
    try:
        named = clusters_from_names(setup.segments, trial.labels) if setup.segments else find_clusters(trial.labels)
    except MareyError as problem:
        raise FileProblem(path, f"does not fit the segments ({str(problem).rstrip('.')})") from None
    clusters = {cluster.segment: cluster for cluster in named.clusters}
    pairs = [pair for pair in usual_joints(tuple(clusters)) if _kind(pair[1]) in CENTRES]
    if not pairs:
        raise FileProblem(
            path, f"has no joint whose centre is sought; its segments are {', '.join(clusters)}",
            "Name pelvis and left_thigh or right_thigh (or thorax and an upperarm) in [segments].",
        )  # fmt: skip
    turned = [_turned(trial, clusters[parent], clusters[child]) for parent, child in pairs]
    parent, child = pairs[int(np.argmax(turned))]
    return clusters[parent], clusters[child]


def _turned(trial: MarkerTrajectories, parent: Cluster, child: Cluster) -> float:
    """Say how much two clusters turn against each other: the spread of the relative rotation."""
    turns = []
    for cluster in (parent, child):
        points = trial.select(cluster.labels).points
        shape = points[int(np.argmax(np.isfinite(points).all(-1).sum(1)))]
        turns.append(fit_rigid(shape, points, 1e-3).rotation)
    relative = np.swapaxes(turns[0], 1, 2) @ turns[1]
    known = relative[np.isfinite(relative).all((1, 2))]
    return float(known.reshape(-1, 9).std(0).sum()) if len(known) else 0.0


def _kind(segment: str) -> str:
    return segment.removeprefix("left_").removeprefix("right_")


def _centre_name(segment: str) -> str:
    side = next((s for s in _SIDES if segment.startswith(s)), "")
    return f"{side}{CENTRES[_kind(segment)]}"


def _in_static(found: FunctionalCentre, parent: Cluster, static: MarkerTrajectories, path: Path) -> Floats:
    """Carry a centre by the parent's markers into the static trial: the mean over its frames."""
    shared = [label for label in parent.labels if label in static.labels]
    if not shared:
        raise FileProblem(path, f"shares no marker of {parent.segment} with the static trial")
    shape = found.parent_shape[[parent.labels.index(label) for label in shared]]
    moved = transfer_point(shape, found.in_parent, static.select(shared).points)
    known = moved[np.isfinite(moved).all(1)]
    if not len(known):
        raise FileProblem(path, f"shares less than three markers of {parent.segment} with the static trial")
    return np.asarray(known.mean(0))


def read_exercise(problem: MarkerProblem, options: MarkersOptions) -> tuple[MarkerProblem, tuple[str, ...]]:
    """Read the exercise from which the markers' motion over the bones is learned.

    Its bones are told by a reference of its own, or carried over from the trial's reference.

    Raises:
        FileProblem: It has other markers, or its reference cannot be used.
    """
    assert options.exercise is not None
    trial = read_markers(options.exercise, unit=options.unit)
    clusters = tuple(
        replace(cluster, labels=tuple(label for label in cluster.labels if label in trial.labels))
        for cluster in problem.clusters
    )
    clusters = tuple(cluster for cluster in clusters if len(cluster.labels) >= 3)
    calibration: AnatomicalCalibration
    if options.exercise_reference is not None:
        segments = tuple(cluster.segment for cluster in clusters)
        calibration, notes = read_reference(options.exercise_reference, segments, frames=len(trial))
    else:
        try:
            moved = transfer_calibration(_posture(problem), trial, clusters)
        except MareyError as fault:
            raise FileProblem(options.exercise, f"does not fit the trial: {fault}".rstrip(".")) from None
        calibration, notes = moved.calibration, moved.notes
    kept = tuple(cluster for cluster in clusters if cluster.segment in calibration.segments)
    joints = tuple(pair for pair in problem.joints if set(pair) <= set(calibration.segments))
    exercise = MarkerProblem(
        trajectories=trial, clusters=kept, calibration=calibration, joints=joints, noise_m=problem.noise_m
    )
    return replace(problem, exercise=exercise), tuple(f"{options.exercise.name}: {note}" for note in notes)


def _posture(problem: MarkerProblem) -> BonesAndMarkers:
    """Give the bones and markers of the trial's first known posture."""
    calibration, trial = problem.calibration, problem.trajectories
    return BonesAndMarkers(
        segments=calibration.segments, rotation=calibration.rotation[0], origin=calibration.origin[0],
        labels=trial.labels, points=trial.points[calibration.frames[0]],
    )  # fmt: skip
