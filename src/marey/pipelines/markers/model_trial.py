"""A marker trial and the OpenSim model that follows it."""

from dataclasses import dataclass

from marey.arrays import Floats
from marey.body.articulation.jointed_body import JointedBody
from marey.io.markers.trial_file import MarkerFile
from marey.io.opensim.osim_model import read_osim_model
from marey.io.opensim.osim_tasks import read_task_values, read_tasks
from marey.markers.data.clusters import Cluster
from marey.markers.kinematics.tasks import TaskSet
from marey.pipelines.marker_sets.chosen_person import file_of
from marey.pipelines.markers.selection import selected_trajectories
from marey.pipelines.markers.settings import MarkerSettings
from marey.pipelines.markers.trial import MarkerTrial


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
        FileProblem: A file cannot be used, or has the markers of several people of whom nobody is chosen.
        SettingProblem: The trial has none of the requested frames.
    """
    assert settings.model is not None
    file = file_of(file, settings.person)
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
