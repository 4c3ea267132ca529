"""A trial's markers and an OpenSim model that follows them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.jointed_body import JointedBody
from marey.errors import FileProblem, MareyError
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.readers import read_markers
from marey.io.markers.results import is_y_up
from marey.io.opensim.mot_sto import Table
from marey.io.opensim.osim_model import read_osim_model
from marey.io.opensim.osim_tasks import read_task_values, read_tasks
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.inverse_kinematics import InverseKinematics, inverse_kinematics
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.tasks import TaskSet
from marey.markers.preprocessing.gaps import FilledGaps
from marey.pipelines.markers.settings import MarkersOptions
from marey.pipelines.markers.trial import asked_frames, cut, filled


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowedModel:
    """What a model found of a trial."""

    bones: BoneMotion
    """The bodies, in the trial's own axes."""
    coordinates: JointKinematics
    """Angles and translations of the model."""
    table: Table
    """All coordinates in the model's order, as OpenSim reads them."""
    notes: tuple[str, ...]
    told: str
    """What was found, in a line."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelTrial:
    """One trial, and the model that is to follow it."""

    path: Path
    measured: MarkerTrajectories
    used: MarkerTrajectories
    """With what was filled, without frames that were not asked for."""
    filling: FilledGaps | None
    """How gaps were filled, where that was asked for."""
    asked: Mask
    model: JointedBody
    model_path: Path
    tasks: TaskSet | None
    targets: dict[str, Floats]
    """Values that the tasks take from a file."""
    clusters: tuple[Cluster, ...]
    """Markers of the trial by the body of the model on which they ride."""
    notes: tuple[str, ...]
    ground_from_file: Floats
    """(3, 3) OpenSim's ground from the trial's axes."""

    def follow(self) -> FollowedModel:
        """Find the model's postures.

        Raises:
            FileProblem: No marker is common to all, or a task names no coordinate.
        """
        turned = replace(self.used, points=self.used.points @ self.ground_from_file.T)
        try:
            found = inverse_kinematics(self.model, self.tasks, turned, targets=self.targets)
        except MareyError as problem:
            remedy = "Give the model that was scaled with this person's markers, and its weights."
            raise FileProblem(
                self.model_path, f"cannot follow {self.path.name}: {problem}".rstrip("."), remedy
            ) from None
        file_from_ground = self.ground_from_file.T
        turn = np.zeros((6, 6))
        turn[:3, :3], turn[3:, 3:] = np.eye(3), file_from_ground
        bones = replace(
            found.bones, rotation=file_from_ground @ found.bones.rotation,
            origin=found.bones.origin @ file_from_ground.T, covariance=turn @ found.bones.covariance @ turn.T,
        )  # fmt: skip
        return FollowedModel(
            bones=bones, coordinates=_coordinates(found), table=_table(found, self.measured.time),
            notes=tuple(found.skipped) + _undetermined(found, self.asked), told=_told(found, self.asked),
        )  # fmt: skip


def read_model_trial(path: Path, options: MarkersOptions) -> ModelTrial:
    """Read a trial, a model and its tasks.

    Raises:
        FileProblem: One of them cannot be used.
        SettingProblem: The frames that are asked for are not there.
    """
    assert options.model is not None
    measured = read_markers(path, unit=options.unit)
    model = read_osim_model(options.model)
    tasks = None if options.weights is None else read_tasks(options.weights)
    targets = {}
    if options.weights is not None and tasks is not None:
        targets = read_task_values(options.weights, tasks, model, measured.time)
    asked = asked_frames(len(measured), options.frames)
    y_up = is_y_up(path)
    riding: dict[str, list[str]] = {}
    for marker in model.markers:
        if marker.body is not None and marker.label in measured.labels:
            riding.setdefault(marker.body, []).append(marker.label)
    clusters = tuple(Cluster(segment=body, labels=tuple(labels)) for body, labels in riding.items())
    used = cut(measured, asked)
    filling = filled(used, clusters, options)
    used = used if filling is None else cut(filling.trajectories, asked)
    turned = "" if y_up else f"{path.name} has Z up; it was turned into the ground of OpenSim, Y up."
    return ModelTrial(
        path=path, measured=measured, used=used, filling=filling, asked=asked, model=model, model_path=options.model,
        tasks=tasks, targets=targets, clusters=clusters,
        notes=(*measured.notes, *(() if filling is None else filling.notes), *([turned] if turned else [])),
        ground_from_file=np.eye(3) if y_up else OPENSIM_FROM_WORLD,
    )  # fmt: skip


def _coordinates(found: InverseKinematics) -> JointKinematics:
    turns = found.rotational
    names = np.array(found.coordinate_names)
    return JointKinematics(
        angle_names=tuple(map(str, names[turns])), angles=found.coordinates[:, turns],
        angles_sd=found.coordinates_sd[:, turns], translation_names=tuple(map(str, names[~turns])),
        translations=found.coordinates[:, ~turns], translations_sd=found.coordinates_sd[:, ~turns],
    )  # fmt: skip


def _table(found: InverseKinematics, time: Floats) -> Table:
    """Give the coordinates in degrees and metres, in the model's order."""
    values = np.where(found.rotational, np.degrees(found.coordinates), found.coordinates)
    return Table(name="Coordinates", columns=found.coordinate_names, time=time, values=values)


def _undetermined(found: InverseKinematics, asked: Mask) -> tuple[str, ...]:
    """Say which coordinates the markers do not determine, although nothing locks them."""
    answered = asked & np.isfinite(found.coordinates).any(1)
    if not answered.any():
        return ("No frame has an answer.",)
    locked = (found.coordinates_sd[answered] == 0).all(0)
    never = [
        name
        for k, name in enumerate(found.coordinate_names)
        if not found.determined[answered, k].any() and not locked[k]
    ]
    return (f"Not determined by the markers: {', '.join(never)}.",) if never else ()


def _told(found: InverseKinematics, asked: Mask) -> str:
    rms = found.rms[asked]
    known = rms[np.isfinite(rms)]
    if not known.size:
        return "No frame has an answer."
    return (
        f"{known.size} of {int(asked.sum())} frames; the {len(found.marker_labels)} markers that were followed lie "
        f"{1e3 * np.sqrt(np.mean(known**2)):.1f} mm from the model (RMS; worst frame {1e3 * known.max():.1f} mm)."
    )
