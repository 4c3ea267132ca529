"""Poses of the bones from a static trial with landmarks, and joint centres from functional trials."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.labels import clusters_from_names, find_clusters
from marey.markers.data.rigid_fit import fit_rigid
from marey.markers.data.setup import MarkerSetup
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.calibration_offsets import CalibrationOffsets, offsets_between
from marey.markers.kinematics.joint_angles import usual_joints
from marey.markers.kinematics.landmark_motion import HeldLandmarks, held_landmarks
from marey.markers.preprocessing.functional import FunctionalCentre, score, transfer_point
from marey.markers.preprocessing.landmarks import AnatomicalFrames, static_bones
from marey.markers.preprocessing.own_frames import TransferredCalibration, transfer_calibration
from marey.pipelines.causes.marker_postures import posture_reasons, standing_reasons
from marey.pipelines.marker_sets.chosen_person import read_file_of, read_markers_of
from marey.pipelines.marker_sets.pointed import with_pointed_landmarks
from marey.pipelines.marker_sets.posture import LandmarkPosture
from marey.pipelines.markers.settings import MarkerSettings
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

LANDMARK_SD_M = 5e-3
"""Standard deviation of a coordinate of a palpated landmark [m]: examiners differ by some millimetres."""
CENTRES = {"thigh": "HJC", "upperarm": "GH"}
"""Names of the landmarks at joint centres, by the segment that rotates about them."""
_SIDES = ("left_", "right_")
"""Prefixes of the segments of one side."""
_ACROSS = (("KJC", "LE", "ME"), ("AJC", "LM", "MM"), ("EJC", "EL", "EM"), ("WJC", "RS", "US"))
"""Names of the centre, the lateral and the medial landmark of each joint."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StaticCalibration:
    """The poses of the bones by a static trial."""

    calibration: AnatomicalCalibration
    """The poses in the frame of the trial that is most similar to the static trial."""
    notes: tuple[str, ...]
    """One sentence each."""
    reasons: tuple[VerdictReason, ...]
    """What contradicts the static trial, with its most likely cause."""
    landmarks: Mapping[str, Floats]
    """Positions (3,) of the landmarks in the laboratory of the static trial [m]."""
    held: HeldLandmarks
    """The landmarks in the frames of their bones."""
    offsets: CalibrationOffsets | None = None
    """How assumed measurements of the person displace the bones; None without any."""


def from_static(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], setup: MarkerSetup, settings: MarkerSettings
) -> StaticCalibration:
    """Find the bones in a static trial by its landmarks, and transfer them to the trial by the shared markers.

    Args:
        trajectories: Markers of the trial.
        clusters: Segments of the trial.
        setup: The content of the TOML; it names the landmarks.
        settings: Name the static trial and the functional trials.

    Returns:
        The poses of the bones, and what contradicts the static trial.

    Raises:
        FileProblem: No landmark is named, or one is missing; no bone can be constructed or transferred.
        NotUsable: No bone can be transferred, and the cause is known.
    """
    assert settings.static is not None
    if not setup.landmarks and setup.pointer is None:
        place = settings.clusters or settings.static
        raise FileProblem(
            place, "names no landmarks; without them a static trial does not give the poses of the bones",
            'Add [landmarks] left_LE = "LKNE", ... to the TOML file clusters (--clusters), or use labels of a known '
            "marker set, or of numbered clusters (R_TH1) with landmarks in the static trial.",
        )  # fmt: skip
    file = read_file_of(settings.static, settings.person, unit=settings.unit, required=not setup.segments)
    pointed: tuple[str, ...] = ()
    landmarks = setup.landmarks
    if setup.pointer is not None:
        segments = {cluster.segment: cluster.labels for cluster in clusters}
        read = partial(read_markers_of, person=settings.person, unit=settings.unit)
        shown = with_pointed_landmarks(file, setup.pointer, segments, read)
        file, pointed = shown.file, shown.notes
        landmarks = {**landmarks, **{name: (name,) for name in setup.pointer.trials}}
    static = file.trajectories
    further, notes = functional_centres(static, setup, settings)
    try:
        mirrored, more = across_centres(static, landmarks)
    except MareyError as problem:
        raise FileProblem(settings.static, _lacks(problem), "Correct [landmarks].") from None
    posture = LandmarkPosture(
        path=settings.static, name=settings.static.name, trajectories=static, y_up=file.y_up,
        landmarks=landmarks, places={**mirrored, **further}, notes=(*pointed, *notes, *more),
    )  # fmt: skip
    return from_posture(posture, trajectories, clusters, side=settings.side)


def _lacks(problem: MareyError) -> str:
    return f"lacks a landmark ({str(problem).rstrip('.')})"


def from_posture(
    posture: LandmarkPosture, trajectories: MarkerTrajectories, clusters: Sequence[Cluster], *, side: str | None
) -> StaticCalibration:
    """Find the bones in a posture by its landmarks, and transfer them to the trial by the shared markers.

    Args:
        posture: The posture with its landmarks.
        trajectories: Markers of the trial.
        clusters: Segments of the trial.
        side: `left` or `right`, for segments whose names do not contain it.

    Returns:
        The poses of the bones, and what contradicts the posture.

    Raises:
        FileProblem: A landmark is missing; no bone can be constructed or transferred.
        NotUsable: No bone can be transferred, and the cause is known.
    """
    name = posture.name
    build = partial(
        static_bones, posture.trajectories, clusters, posture.landmarks, landmark_sd_m=LANDMARK_SD_M, side=side
    )
    try:
        bones, found = build(further=posture.places)
    except MareyError as problem:
        raise FileProblem(posture.path, _lacks(problem), posture.remedy) from None
    if not found.frames:
        raise FileProblem(posture.path, f"gives no bone: {' '.join(found.notes)}".rstrip("."), "Add landmarks.")
    notes = [*posture.notes, _landmark_text(name, found)]
    reasons = (
        *posture_reasons(name, trajectories, clusters, bones), *standing_reasons(name, bones, y_up=posture.y_up)
    )  # fmt: skip
    try:
        moved = transfer_calibration(bones, trajectories, clusters)
    except MareyError as problem:
        if any(reason.level == "not usable" for reason in reasons):
            raise NotUsable(Verdict.of(reasons)) from None
        raise FileProblem(posture.path, f"does not fit the trial: {problem}".rstrip(".")) from None
    notes += [*found.notes, *moved.notes, _carried_text(moved)]
    offsets = None
    if posture.assumed:
        larger = [build(further=places)[0] for places in posture.shifted]
        offsets = offsets_between(posture.assumed, bones, larger)
    return StaticCalibration(
        calibration=moved.calibration, notes=tuple(notes), reasons=reasons, landmarks=found.landmarks,
        held=held_landmarks(found.landmarks, found.frames), offsets=offsets,
    )  # fmt: skip


def _landmark_text(name: str, found: AnatomicalFrames) -> str:
    """Describe what the error of the landmarks does to the axes of the bones."""
    turns = [float(np.degrees(np.sqrt(np.diag(f.covariance)[:3].max()))) for f in found.frames]
    turn_text = ", ".join(f"{f.segment} {turn:.1f}" for f, turn in zip(found.frames, turns, strict=True))
    return (
        f"Bones from the landmarks of {name}. With landmarks palpated to {1e3 * LANDMARK_SD_M:.0f} mm, "
        f"the standard deviation of a bone's axes is (degrees): {turn_text}. This error is constant and is not part "
        "of the standard deviations in the results."
    )


def across_centres(
    static: MarkerTrajectories, landmarks: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Floats], list[str]]:
    """Reflect lateral landmarks at the joint centre to obtain missing medial landmarks.

    Many marker sets have only the lateral landmark and the centre of a joint (`left_KJC`, `left_AJC`).

    Args:
        static: The static trial.
        landmarks: Landmarks and their markers, as the TOML names them.

    Returns:
        The place (3,) of each landmark in the laboratory of the static trial [m], and notes.

    Raises:
        MareyError: A landmark names a marker that the static trial does not have.
    """
    places: dict[str, Floats] = {}
    notes: list[str] = []
    for side in ("", *_SIDES):
        for centre, lateral, medial in _ACROSS:
            names = [f"{side}{name}" for name in (centre, lateral, medial)]
            if names[0] in landmarks and names[1] in landmarks and names[2] not in landmarks:
                middle, outer = (_mean_place(static, landmarks[name]) for name in names[:2])
                places[names[2]] = 2 * middle - outer
                notes.append(f"{names[2]} is {names[1]} reflected at {names[0]}.")
    return places, notes


def _mean_place(static: MarkerTrajectories, labels: Sequence[str]) -> Floats:
    """Return the mean position (3,) of one marker, or of the midpoint of several; NaN if one is never visible."""
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
    return f"Frame {frame} is most similar to the static trial; distance of the markers (mm, RMS): {each}."


def functional_centres(
    static: MarkerTrajectories, setup: MarkerSetup, settings: MarkerSettings
) -> tuple[dict[str, Floats], list[str]]:
    """Estimate joint centres from functional trials, and transfer them to the static trial.

    In each functional trial it is the joint whose two bones rotate most relative to each other.

    Args:
        static: The static trial; the markers of the parent segment are in both.
        setup: The content of the TOML; it names the segments.
        settings: Name the functional trials.

    Returns:
        The place (3,) of each centre in the laboratory of the static trial [m], and notes.

    Raises:
        FileProblem: A trial has no such joint, or the static trial lacks the markers of the parent segment.
    """
    places, notes = {}, []
    for path in settings.functional:
        file = read_file_of(path, settings.person, unit=settings.unit, required=not setup.segments)
        trial = file.trajectories
        parent, child = _moved_joint(path, trial, setup)
        try:
            found = score(trial.select(parent.labels).points, trial.select(child.labels).points)
        except MareyError as problem:
            raise FileProblem(path, f"does not determine the joint's centre ({str(problem).rstrip('.')})") from None
        name = _centre_name(child.segment)
        places[name] = _in_static(found, parent, static, path)
        sd = 1e3 * float(np.sqrt(np.diag(found.covariance).max()))
        notes.append(
            f"{name} is the centre about which {child.segment} rotates relative to {parent.segment} in {path.name}: "
            f"standard deviation {sd:.1f} mm; the centres fixed to the two bones are "
            f"{1e3 * found.residual:.1f} mm apart (RMS)."
        )
    return places, notes


def _moved_joint(path: Path, trial: MarkerTrajectories, setup: MarkerSetup) -> tuple[Cluster, Cluster]:
    """Find the joint of a functional trial: among those with a centre, the one that rotates most."""
    try:
        named = clusters_from_names(setup.segments, trial.labels) if setup.segments else find_clusters(trial.labels)
    except MareyError as problem:
        raise FileProblem(path, f"does not fit the segments ({str(problem).rstrip('.')})") from None
    clusters = {cluster.segment: cluster for cluster in named.clusters}
    pairs = [pair for pair in usual_joints(tuple(clusters)) if _kind(pair[1]) in CENTRES]
    if not pairs:
        raise FileProblem(
            path, f"has no joint whose centre can be estimated; its segments are {', '.join(clusters)}",
            "Name pelvis and left_thigh or right_thigh (or thorax and an upperarm) in [segments].",
        )  # fmt: skip
    turned = [_turned(trial, clusters[parent], clusters[child]) for parent, child in pairs]
    parent, child = pairs[int(np.argmax(turned))]
    return clusters[parent], clusters[child]


def _turned(trial: MarkerTrajectories, parent: Cluster, child: Cluster) -> float:
    """Return the spread of the relative rotation of two clusters."""
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
    """Transfer a centre to the static trial by the markers of the parent segment: the mean over its frames."""
    shared = [label for label in parent.labels if label in static.labels]
    if not shared:
        raise FileProblem(path, f"shares no marker of {parent.segment} with the static trial")
    shape = found.parent_shape[[parent.labels.index(label) for label in shared]]
    moved = transfer_point(shape, found.in_parent, static.select(shared).points)
    known = moved[np.isfinite(moved).all(1)]
    if not len(known):
        raise FileProblem(path, f"shares fewer than three markers of {parent.segment} with the static trial")
    return np.asarray(known.mean(0))
