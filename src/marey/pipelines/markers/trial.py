"""A marker trial as input of the methods: trajectories, segments, and the poses of the bones in some frames."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from marey.arrays import Floats, Integers
from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.markers.setup import given_measurements, read_marker_setup
from marey.io.markers.trial_file import MarkerFile
from marey.markers.data.clusters import Cluster
from marey.markers.data.labels import MOST_LABELS, FoundClusters, clusters_from_names, find_clusters
from marey.markers.data.marker_set_tables import plain_label
from marey.markers.data.marker_sets import (
    RecognisedSet,
    choose_marker_set,
    cluster_marker_set,
    given_marker_set,
    labels_by_person,
    recognise_marker_sets,
    with_landmark_labels,
)
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.setup import MarkerSetup, Pointer
from marey.markers.kinematics.calibration_offsets import CalibrationOffsets
from marey.markers.kinematics.landmark_motion import HeldLandmarks
from marey.pipelines.marker_sets.chosen_person import file_of, read_file_of, read_markers_of
from marey.pipelines.marker_sets.pointed import PointedLandmarks, with_pointed_landmarks
from marey.pipelines.marker_sets.prepared import PreparedSet, prepare_marker_set
from marey.pipelines.markers.calibration import Calibrated, calibrated
from marey.pipelines.markers.exercise import read_exercise
from marey.pipelines.markers.selection import SelectedTrajectories, selected_trajectories
from marey.pipelines.markers.settings import MarkerSettings
from marey.pipelines.verdict import VerdictReason

_NAME_SEGMENTS = 'Name the segments in a TOML, [segments] thigh = ["label", ...], and give it as clusters (--clusters).'
"""Remedy for labels that name no segments."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerTrial(ABC):
    """A trial of skin markers with everything that is known about it, as `marey.open_markers` returns it."""

    file: MarkerFile
    """The content of the trial's file."""
    settings: MarkerSettings
    """The settings with which the trial was opened."""
    selection: SelectedTrajectories
    """The frames to be estimated, with filled gaps if that was requested."""
    notes: tuple[str, ...]
    """What was skipped or decided while the trial was read, one sentence each."""

    @property
    def path(self) -> Path:
        """The trial's file."""
        return self.file.path

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the M markers."""
        return self.file.trajectories.labels

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return self.file.trajectories.rate

    @property
    def time(self) -> Floats:
        """(F,) time of each frame [s]."""
        return self.file.trajectories.time

    @property
    def points(self) -> Floats:
        """(F, M, 3) positions of the markers in the laboratory [m]; NaN where a marker is missing."""
        return self.selection.used.points

    @property
    @abstractmethod
    def clusters(self) -> tuple[Cluster, ...]:
        """The segments and the labels of the markers on each."""

    @property
    def segments(self) -> tuple[str, ...]:
        """Names of the segments whose bones can be estimated."""
        return tuple(cluster.segment for cluster in self.clusters)

    @property
    def anatomical(self) -> bool:
        """Whether the bones' frames are anatomical; otherwise they are the clusters' principal axes."""
        return True

    @property
    def side(self) -> str | None:
        """`left` or `right`, if it is known and the names of the segments do not contain it."""
        return None

    @property
    def reference_frames(self) -> Integers | None:
        """(K,) frames in which the poses of the bones are known; None for a model."""
        return None

    @property
    def landmarks(self) -> Mapping[str, Floats]:
        """Positions (3,) of the landmarks in the static trial [m]; empty without one."""
        return {}

    @property
    def files(self) -> list[Path]:
        """All files that were read, the trial first."""
        return [self.path, *self.settings.files]

    def __len__(self) -> int:
        return len(self.file.trajectories)

    def __repr__(self) -> str:
        seen = 100 * float(self.file.trajectories.present.mean())
        return (
            f"<{type(self).__name__} {self.path.name}: {len(self.labels)} markers, {len(self)} frames at "
            f"{self.rate:g} Hz, {seen:.1f} % of the points seen; segments: {', '.join(self.segments) or 'none'}>"
        )


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ClusterTrial(MarkerTrial):
    """A trial with at least three markers on each segment."""

    problem: MarkerProblem
    """The input of every method."""
    has_anatomy: bool
    """Whether the bones' frames are anatomical; otherwise they are the clusters' principal axes."""
    faults: tuple[str, ...] = ()
    """Faults of the markers, one sentence each; they are among the notes."""
    wrong_units: tuple[str, ...] = ()
    """Those of the faults that make every result wrong."""
    reasons: tuple[VerdictReason, ...] = ()
    """What contradicts the static trial, with its most likely cause; it is among the notes."""
    known_side: str | None = None
    """`left` or `right`, if it is known and the names of the segments do not contain it."""
    known_set: str | None = None
    """Name of the marker set from whose labels the segments and landmarks come; None without one."""
    held_landmarks: HeldLandmarks = field(default_factory=HeldLandmarks)
    """The landmarks in the frames of their bones; none without a static trial."""
    offsets: CalibrationOffsets | None = None
    """How assumed measurements of the person displace the bones; None without any."""
    static_landmarks: Mapping[str, Floats] = field(default_factory=dict)
    """Positions (3,) of the landmarks in the static trial [m]; empty without one."""
    pointer_files: tuple[Path, ...] = ()
    """Trials of a pointer that the TOML names."""

    @property
    def files(self) -> list[Path]:
        """All files that were read, the trial first."""
        return [*super().files, *self.pointer_files]

    @property
    def landmarks(self) -> Mapping[str, Floats]:
        """Positions (3,) of the landmarks in the static trial [m]; empty without one."""
        return self.static_landmarks

    @property
    def clusters(self) -> tuple[Cluster, ...]:
        """The segments and the labels of the markers on each."""
        return self.problem.clusters

    @property
    def side(self) -> str | None:
        """`left` or `right`, if it is known and the names of the segments do not contain it."""
        return self.known_side

    @property
    def anatomical(self) -> bool:
        """Whether the bones' frames are anatomical; otherwise they are the clusters' principal axes."""
        return self.has_anatomy

    @property
    def reference_frames(self) -> Integers | None:
        """(K,) frames in which the poses of the bones are known."""
        return self.problem.calibration.frames

    @property
    def key(self) -> object:
        """Everything on which the result of a method depends, apart from the files."""
        problem = self.problem
        return (
            [(c.segment, c.labels) for c in problem.clusters], problem.calibration, list(problem.joints),
            list(problem.degrees_of_freedom), problem.noise_m, self.selection.frames, self.selection.used.points,
            problem.exercise is not None,
            [(name, s.form, s.period_s, s.pieces, s.functions, s.still) for name, s in problem.skin.items()],
        )  # fmt: skip


def cluster_trial(file: MarkerFile, settings: MarkerSettings) -> ClusterTrial:
    """Combine a trial with what its settings state about segments and bones.

    Args:
        file: The content of the trial's file.
        settings: Name the other files.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: A setting does not fit the trial.
    """
    setup = MarkerSetup() if settings.clusters is None else read_marker_setup(settings.clusters)
    file = file_of(file, settings.person, required=not setup.segments)
    prepared = _with_marker_set(file, setup, settings)
    if prepared is not None:
        file = prepared.file
    elif settings.measurements:
        raise SettingProblem(
            "measurements (--measurements) apply to trials with a known marker set, from whose labels segments and "
            "joints follow: leave them out."
        )
    posture, limits = (None, ()) if prepared is None else (prepared.posture, prepared.reasons)
    found = _segments_of(file, setup, settings) if prepared is None else _with_skin_of(prepared.found, setup)
    selection = selected_trajectories(file.trajectories, found.clusters, settings)
    bones = calibrated(file, selection, found.clusters, setup, settings, posture)
    problem = _problem(bones, found.clusters, setup)
    notes = [*file.trajectories.notes, *found.notes, *selection.notes, *bones.notes, *map(str, limits)]
    if problem.joints:
        notes += bones.side_notes
    if settings.exercise is not None:
        problem, more = read_exercise(problem, settings)
        notes += more
    if not problem.joints:
        notes.append("There are no joint angles: no joint between the segments is known. Add [joints] to the TOML.")
    return ClusterTrial(
        file=file, settings=settings, selection=replace(selection, used=bones.trajectories), notes=tuple(notes),
        problem=problem, has_anatomy=bones.anatomical, known_side=bones.side,
        faults=bones.faults, wrong_units=bones.wrong_units, reasons=(*bones.reasons, *limits),
        known_set=None if prepared is None else prepared.name, static_landmarks=bones.landmarks,
        pointer_files=() if setup.pointer is None else setup.pointer.files,
        held_landmarks=bones.held, offsets=bones.offsets,
    )  # fmt: skip


def _with_marker_set(file: MarkerFile, setup: MarkerSetup, settings: MarkerSettings) -> PreparedSet | None:
    """Prepare a trial whose labels are those of a known set; None if there is none, or the settings name segments."""
    if setup.segments or setup.landmarks or settings.reference is not None:
        _require_no_set(setup, settings, file)
        return None
    static = None
    if settings.static is not None:
        static = read_file_of(settings.static, settings.person, unit=settings.unit)
    shown = () if setup.pointer is None else tuple(setup.pointer.trials)
    if settings.marker_set is None:
        recognised = _recognised(file, static, shown)
    else:
        recognised = given_marker_set(choose_marker_set(settings.marker_set), file.trajectories.labels)
    if recognised is None:
        return None
    notes: tuple[str, ...] = ()
    if setup.pointer is not None:
        recognised = replace(recognised, marker_set=with_landmark_labels(recognised.marker_set, shown))
        pointed = _with_pointer(file if static is None else static, setup.pointer, recognised, settings)
        file, static = (pointed.file, None) if static is None else (file, pointed.file)
        notes = pointed.notes
    person = given_measurements(settings.measurements).completed_by(setup.person)
    moved = [read_file_of(path, settings.person, unit=settings.unit) for path in settings.functional]
    prepared = prepare_marker_set(file, recognised, person, static=static, functional=moved)
    return replace(prepared, posture=replace(prepared.posture, notes=(*notes, *prepared.posture.notes)))


def _with_pointer(
    file: MarkerFile, pointer: Pointer, recognised: RecognisedSet, settings: MarkerSettings
) -> PointedLandmarks:
    """Add the landmarks that a pointer showed to the file of the posture."""
    own = labels_by_person(file.trajectories.labels).get(recognised.person, {})
    segments = {
        segment: [own[plain] for label in labels if (plain := plain_label(label)) in own]
        for segment, labels in recognised.marker_set.segments.items()
    }
    read = partial(read_markers_of, person=settings.person, unit=settings.unit)
    return with_pointed_landmarks(file, pointer, segments, read)


def _require_no_set(setup: MarkerSetup, settings: MarkerSettings, file: MarkerFile) -> None:
    """Check that no marker set is named beside segments.

    Raises:
        FileProblem: A set is named.
    """
    if settings.marker_set is not None:
        place = settings.clusters or file.path
        wrong = "names [segments] or [landmarks], which marker_set (--marker-set) defines"
        raise FileProblem(place, wrong, "Remove them, or leave out the set.")


def _recognised(file: MarkerFile, static: MarkerFile | None, shown: Sequence[str]) -> RecognisedSet | None:
    """Return the known set of the labels, or clusters whose landmarks are known otherwise; None without one.

    Args:
        file: The trial.
        static: The static trial, whose markers may be on landmarks; None if there is none.
        shown: Landmarks that a pointer showed.
    """
    labels = file.trajectories.labels
    sets = recognise_marker_sets(labels)
    if sets or (static is None and not shown):
        return sets[0] if sets else None
    still = labels if static is None else static.trajectories.labels
    return cluster_marker_set(labels, [*still, *shown])


def _with_skin_of(found: FoundClusters, setup: MarkerSetup) -> FoundClusters:
    """Check that the TOML describes the skin of known segments only."""
    there = [cluster.segment for cluster in found.clusters]
    unknown = sorted(set(setup.skin) - set(there))
    if unknown:
        raise SettingProblem(
            f"[skin] names the unknown segment {', '.join(unknown)}; the segments are: {', '.join(there)}."
        )
    return found


def _segments_of(file: MarkerFile, setup: MarkerSetup, settings: MarkerSettings) -> FoundClusters:
    """Find the segments, and check that the TOML describes the skin of these only."""
    return _with_skin_of(_found_segments(file, setup, settings), setup)


def _found_segments(file: MarkerFile, setup: MarkerSetup, settings: MarkerSettings) -> FoundClusters:
    """Find the segments that the TOML names, or those that the labels indicate."""
    labels = file.trajectories.labels
    if setup.segments:
        try:
            return clusters_from_names(setup.segments, labels)
        except MareyError as problem:
            wrong = f"does not fit {file.path.name} ({str(problem).rstrip('.')})"
            raise FileProblem(settings.clusters or file.path, wrong) from problem
    found = find_clusters(labels)
    sets = tuple(one.sentence for one in recognise_marker_sets(labels))
    if not found.clusters:
        some = ", ".join(labels[:MOST_LABELS]) + (", ..." if len(labels) > MOST_LABELS else "")
        raise FileProblem(
            file.path,
            f"has no three labels that differ only by a number, so its segments are unknown; its labels are {some}",
            " ".join((*sets, _NAME_SEGMENTS)),
        )
    return replace(found, notes=(*sets, *found.notes))


def _problem(bones: Calibrated, clusters: Sequence[Cluster], setup: MarkerSetup) -> MarkerProblem:
    known = bones.calibration.segments
    problem = MarkerProblem(
        trajectories=bones.trajectories, clusters=tuple(c for c in clusters if c.segment in known),
        calibration=bones.calibration, joints=bones.joints, skin=setup.skin,
    )  # fmt: skip
    degrees = {(j.parent, j.child): j.degrees_of_freedom for j in setup.joints}
    if degrees:
        problem = replace(problem, degrees_of_freedom=tuple(degrees[pair] for pair in problem.joints))
    return problem if setup.noise_m is None else replace(problem, noise_m=setup.noise_m)
