"""From the skin markers of a trial to the motion of the bones beneath them."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from marey.errors import MareyError, SettingProblem
from marey.io.markers.trial_file import read_marker_file
from marey.markers.methods.methods import DEFAULT_METHOD
from marey.pipelines.consistency.unusable import UnusableRun, with_unusable_page
from marey.pipelines.gait.repetitions import count_repetitions, repetitions_of_markers
from marey.pipelines.markers.bones import COMMAND, Bones
from marey.pipelines.markers.estimated_bones import MethodRun
from marey.pipelines.markers.events import find_gait, walk_paths
from marey.pipelines.markers.method_runs import run_methods
from marey.pipelines.markers.model_run import run_model
from marey.pipelines.markers.model_trial import ModelTrial, model_trial
from marey.pipelines.markers.results import RESULTS
from marey.pipelines.markers.settings import MarkerSettings
from marey.pipelines.markers.trial import ClusterTrial, MarkerTrial, cluster_trial
from marey.pipelines.markers.verdict import bones_verdict, failed_verdict
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import RunDetails, checkpoints
from marey.pipelines.run_record import StageCache
from marey.pipelines.values import Frames, PathLike, first_and_end, issue_warnings, optional_path, path_tuple
from marey.pipelines.verdict import NotUsable, Verdict

_NO_BONES = (
    "No motion of bones was estimated: the verdict states why the markers do not determine it. After the cause is "
    "removed, run the same command again."
)
"""What the page of a run without a result explains."""


def open_markers(
    path: PathLike,
    *,
    reference: PathLike | None = None,
    clusters: PathLike | None = None,
    static: PathLike | None = None,
    functional: Iterable[PathLike] = (),
    exercise: PathLike | None = None,
    exercise_reference: PathLike | None = None,
    model: PathLike | None = None,
    weights: PathLike | None = None,
    frames: Frames | None = None,
    fill: str = "none",
    unit: str | None = None,
    side: str | None = None,
    marker_set: str | None = None,
    person: str | None = None,
    measurements: Mapping[str, float] | None = None,
    out: PathLike | None = None,
    progress: Progress | None = None,
) -> MarkerTrial:
    """Open a trial of skin markers, with everything that is known about its bones.

    Args:
        path: A C3D, TRC or CSV with the trajectories of the markers.
        reference: NPZ with the poses of the bones in one frame of the trial, or in several.
        clusters: TOML with the markers on each segment, landmarks, joints, noise, measurements of the person, and
            trials of a pointer.
            Without segments in it, they are those of a known marker set; otherwise the markers `thigh_01`, `thigh_02`,
            ... are on the segment `thigh`.
        static: Trial of the person standing, with the landmarks that the TOML names or the marker set has.
        functional: Trials in which a hip or shoulder was moved; they give the joint's centre.
        exercise: Trial from which the method `artefact` learns the motion of the skin.
        exercise_reference: NPZ with the poses of the bones in frames of the exercise.
        model: OpenSim model that is to follow the markers.
        weights: OpenSim tasks of the model; by default all markers have the same weight.
        frames: Frames to be estimated, counted from 0; all by default.
        fill: How gaps are filled: `spline` (over time), `cluster` (from the segment's other markers), `best` or `none`.
        unit: mm, cm or m, if the file states its unit wrongly.
        side: `left` or `right`, if the names of the segments do not contain it.
        marker_set: Key of the marker set of the labels, such as `pig-lower`; by default it is recognised.
        person: Name of the person before the labels (`Ann:LASI`), if the files have the markers of several people.
        measurements: Measurements of the person for a known marker set, by the keys of `[person]` in the TOML, such as
            `{"knee_width_mm": 99}` [mm]; they replace those of files.
        out: Folder for the results. If it is given, the page and the record of a trial that is not usable are written
            there.
        progress: Progress reporter.

    Returns:
        The trial, for `estimate_bones`.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: A value is impossible, or two settings exclude each other.
        NotUsable: The static trial does not fit, and the cause is known.

    Example:
        >>> import marey
        >>> walk = marey.open_markers("walk.c3d", reference="walk_frame0.npz")
        >>> walk.segments
        ('thigh', 'shank')
    """
    settings = MarkerSettings(
        reference=optional_path(reference), clusters=optional_path(clusters), static=optional_path(static),
        functional=path_tuple(functional), exercise=optional_path(exercise),
        exercise_reference=optional_path(exercise_reference), model=optional_path(model),
        weights=optional_path(weights),
        frames=first_and_end(frames), fill=fill, unit=unit, side=side, marker_set=marker_set,
        person=person, measurements=measurements or {},
    )  # fmt: skip
    reporter = progress or RecordingProgress()
    with reporter.stage("Reading"):
        file = read_marker_file(Path(path), unit=unit)
    with with_unusable_page(optional_path(out), partial(_unusable, Path(path), settings), reporter):
        return cluster_trial(file, settings) if model is None else model_trial(file, settings)


def _given(settings: MarkerSettings) -> dict[str, object]:
    """Return the settings that were given, for run.json."""
    return {name: value for name, value in vars(settings).items() if value not in (None, (), {})}


def _unusable(path: Path, settings: MarkerSettings, verdict: Verdict) -> UnusableRun:
    """Describe a run whose markers do not determine the motion of the bones."""
    return UnusableRun(
        command=COMMAND, kind="Motion of bones from skin markers", title=path.name, page="report.html",
        happened=_NO_BONES, settings=_given(settings), inputs=[path, *settings.files], root=path.parent,
        verdict=verdict,
    )  # fmt: skip


def estimate_bones(
    trial: MarkerTrial,
    method: str | Sequence[str] | None = None,
    *,
    out: PathLike | None = None,
    progress: Progress | None = None,
) -> Bones:
    """Estimate the motion of the bones beneath the markers of a trial.

    Args:
        trial: The trial, as `open_markers` returns it.
        method: Name of a method, several of them, or `all`; `skin` by default. A trial with an OpenSim model has its
            own method.
        out: Folder for the results. If it is given, the files of `marey markers` are written there, and an
            interrupted run can be resumed by the same call; otherwise nothing is written.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The motion of the bones.

    Raises:
        SettingProblem: A method is unknown, or the trial lacks what it needs.
        NotUsable: The markers do not determine the motion.

    Example:
        >>> import marey
        >>> walk = marey.open_markers("walk.c3d", reference="walk_frame0.npz")
        >>> bones = marey.estimate_bones(walk, method="rigid")
        >>> low, high = bones.angles["knee flexion"].interval(0.95)
    """
    if isinstance(trial, ModelTrial) and method is not None:
        raise SettingProblem("model (--model) and method (--method) exclude each other: leave out one of them.")
    reporter = RecordingProgress() if progress is None else progress
    for note in trial.notes:
        reporter.warn(note)
    folder, inputs = None if out is None else Path(out), trial.files
    with checkpoints(folder, inputs, results=RESULTS) as cache:
        with with_unusable_page(folder, partial(_unusable, trial.path, trial.settings), reporter):
            runs = _runs(trial, method, reporter, cache)
        gait = find_gait(trial.file, trial.clusters, side=trial.side)
        for note in gait.notes:
            reporter.warn(note)
        paths = walk_paths(trial.file, trial.clusters, side=trial.side)
        repetitions = repetitions_of_markers(paths, runs[0].joints, gait)
        if len(repetitions):
            reporter.warn(f"Repetitions: {count_repetitions(repetitions)}.")
        about = {**_given(trial.settings), "methods": [run.name for run in runs]}
        if isinstance(trial, ClusterTrial) and trial.known_set is not None:
            about["marker_set"] = trial.known_set
        if trial.file.name:
            about["person"] = trial.file.name
        bones = Bones(
            runs=tuple(runs), time=trial.time, frames=trial.selection.frames, gait=gait, repetitions=repetitions,
            anatomical=trial.anatomical, side=trial.side, reference_frames=trial.reference_frames,
            given_angles=trial.file.angles, trial=trial,
            details=RunDetails.of(
                COMMAND, about, inputs, trial.path.parent, reporter, verdict=bones_verdict(trial, runs[0])
            ),
        )  # fmt: skip
        if folder is not None:
            bones.save(folder, progress=reporter)
    if progress is None:
        issue_warnings(reporter)
    return bones


def _runs(
    trial: MarkerTrial, method: str | Sequence[str] | None, progress: Progress, cache: StageCache
) -> Sequence[MethodRun]:
    """Run the methods, or let the model follow the markers.

    Raises:
        NotUsable: No method finds the motion.
    """
    try:
        if isinstance(trial, ModelTrial):
            return [run_model(trial, progress)]
        if not isinstance(trial, ClusterTrial):
            raise TypeError(f"estimate_bones takes what open_markers returns, not a {type(trial).__name__}")
        names = (method,) if isinstance(method, str) else tuple(method or (DEFAULT_METHOD,))
        return run_methods(trial, names, progress, cache)
    except MareyError as problem:
        if type(problem) is not MareyError:  # a wrong setting or file, and not the markers
            raise
        raise NotUsable(failed_verdict(trial, str(problem))) from problem
