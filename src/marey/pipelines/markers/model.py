"""A marker trial and the OpenSim model that follows it."""

import time
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.jointed_body import JointedBody
from marey.errors import FileProblem, MareyError
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.trial_file import MarkerFile
from marey.io.opensim.mot_sto import TimeSeriesTable
from marey.io.opensim.osim_model import read_osim_model
from marey.io.opensim.osim_tasks import read_task_values, read_tasks
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import Cluster
from marey.markers.data.marker_motion import marker_motion
from marey.markers.kinematics.inverse_kinematics import InverseKinematics, inverse_kinematics
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.tasks import TaskSet
from marey.pipelines.markers.estimated_bones import MethodRun
from marey.pipelines.markers.selection import selected_trajectories
from marey.pipelines.markers.settings import MarkerSettings
from marey.pipelines.markers.trial import MarkerTrial
from marey.pipelines.progress import Progress


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ModelTrial(MarkerTrial):
    """A trial of skin markers and the OpenSim model whose coordinates are estimated."""

    model: JointedBody
    tasks: TaskSet | None
    """Weights of markers and coordinates; None if all markers have the same weight."""
    targets: dict[str, Floats]
    """Values of coordinates that the tasks take from a file."""
    riding: tuple[Cluster, ...]
    """Bodies of the model and the labels of the trial's markers on each."""

    @property
    def clusters(self) -> tuple[Cluster, ...]:
        """The bodies of the model and the labels of the markers on each."""
        return self.riding


def model_trial(file: MarkerFile, settings: MarkerSettings) -> ModelTrial:
    """Combine a trial with an OpenSim model and its tasks.

    Args:
        file: The content of the trial's file.
        settings: Name the model and its tasks.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: The trial has none of the requested frames.
    """
    assert settings.model is not None
    measured = file.trajectories
    model = read_osim_model(settings.model)
    tasks = None if settings.weights is None else read_tasks(settings.weights)
    targets = {}
    if settings.weights is not None and tasks is not None:
        targets = read_task_values(settings.weights, tasks, model, measured.time)
    labels: dict[str, list[str]] = {}
    for marker in model.markers:
        if marker.body is not None and marker.label in measured.labels:
            labels.setdefault(marker.body, []).append(marker.label)
    riding = tuple(Cluster(segment=body, labels=tuple(each)) for body, each in labels.items())
    selection = selected_trajectories(measured, riding, settings)
    turned = f"{file.path.name} has Z up; it was rotated into the ground frame of OpenSim, which has Y up."
    return ModelTrial(
        file=file, settings=settings, selection=selection, model=model, tasks=tasks, targets=targets, riding=riding,
        notes=(*measured.notes, *selection.notes, *(() if file.y_up else (turned,))),
    )  # fmt: skip


def run_model(trial: ModelTrial, progress: Progress) -> MethodRun:
    """Estimate the coordinates of the model in every frame, by inverse kinematics.

    Args:
        trial: The markers and the model.
        progress: Progress reporter.

    Raises:
        FileProblem: Model, tasks and trial have no marker in common, or a task names an unknown coordinate.
    """
    selection, model = trial.selection, trial.settings.model or trial.path
    ground_from_file = np.eye(3) if trial.file.y_up else OPENSIM_FROM_WORLD
    turned = replace(selection.used, points=selection.used.points @ ground_from_file.T)
    with progress.stage("Inverse kinematics"):
        began = time.perf_counter()
        try:
            found = inverse_kinematics(trial.model, trial.tasks, turned, targets=trial.targets)
        except MareyError as problem:
            wrong = f"cannot follow {trial.path.name}: {problem}".rstrip(".")
            remedy = "Give the model that was scaled to this person, and tasks for its markers."
            raise FileProblem(model, wrong, remedy) from None
        seconds = time.perf_counter() - began
    for note in (*found.skipped, *_undetermined(found, selection.frames)):
        progress.warn(note)
    bones = _in_axes_of_file(found.bones, ground_from_file.T)
    return MethodRun(
        name="model", summary=f"the OpenSim model {model.name}", motion=bones, joints=_coordinates(found),
        seconds=seconds, table=_table(found, trial.time), fit=_summary(found, selection.frames),
        markers=marker_motion(selection.used, trial.clusters, bones),
    )  # fmt: skip


def _in_axes_of_file(bones: BoneMotion, file_from_ground: Floats) -> BoneMotion:
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = np.eye(3), file_from_ground
    return replace(
        bones, rotation=file_from_ground @ bones.rotation, origin=bones.origin @ file_from_ground.T,
        covariance=turn @ bones.covariance @ turn.T,
    )  # fmt: skip


def _coordinates(found: InverseKinematics) -> JointKinematics:
    turns = found.rotational
    names = np.array(found.coordinate_names)
    return JointKinematics(
        angle_names=tuple(map(str, names[turns])), angles=found.coordinates[:, turns],
        angles_sd=found.coordinates_sd[:, turns], translation_names=tuple(map(str, names[~turns])),
        translations=found.coordinates[:, ~turns], translations_sd=found.coordinates_sd[:, ~turns],
    )  # fmt: skip


def _table(found: InverseKinematics, time: Floats) -> TimeSeriesTable:
    """Return the coordinates in degrees and metres, in the model's order."""
    values = np.where(found.rotational, np.degrees(found.coordinates), found.coordinates)
    return TimeSeriesTable(name="Coordinates", columns=found.coordinate_names, time=time, values=values)


def _undetermined(found: InverseKinematics, frames: Mask) -> tuple[str, ...]:
    """List the unlocked coordinates that the markers do not determine."""
    answered = frames & np.isfinite(found.coordinates).any(1)
    if not answered.any():
        return ("No frame has a result.",)
    locked = (found.coordinates_sd[answered] == 0).all(0)
    never = [
        name
        for k, name in enumerate(found.coordinate_names)
        if not found.determined[answered, k].any() and not locked[k]
    ]
    return (f"Not determined by the markers: {', '.join(never)}.",) if never else ()


def _summary(found: InverseKinematics, frames: Mask) -> str:
    rms = found.rms[frames]
    known = rms[np.isfinite(rms)]
    if not known.size:
        return "No frame has a result."
    return (
        f"{known.size} of {int(frames.sum())} frames; distance of the {len(found.marker_labels)} markers from the "
        f"model: {1e3 * np.sqrt(np.mean(known**2)):.1f} mm (RMS; worst frame {1e3 * known.max():.1f} mm)."
    )
