"""Running inverse kinematics on a marker trial with an OpenSim model."""

import time
from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import FileProblem, MareyError
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.opensim.mot_sto import TimeSeriesTable
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import marker_motion
from marey.markers.kinematics.inverse_kinematics import InverseKinematics, inverse_kinematics
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.pipelines.markers.estimated_bones import MethodRun
from marey.pipelines.markers.model_trial import ModelTrial
from marey.pipelines.progress import Progress


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
    never = _undetermined(found, selection.frames)
    for note in (*found.skipped, *((f"Not determined by the markers: {', '.join(never)}.",) if never else ())):
        progress.warn(note)
    bones = _in_axes_of_file(found.bones, ground_from_file.T)
    return MethodRun(
        name="model", summary=f"the OpenSim model {model.name}", motion=bones, joints=_coordinates(found),
        seconds=seconds, table=_table(found, trial.time), fit=_summary(found, selection.frames),
        markers=marker_motion(selection.used, trial.clusters, bones), undetermined=never,
        model_rms_m=_distance_m(found, selection.frames),
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
        return ()
    locked = (found.coordinates_sd[answered] == 0).all(0)
    return tuple(
        name
        for k, name in enumerate(found.coordinate_names)
        if not found.determined[answered, k].any() and not locked[k]
    )


def _distance_m(found: InverseKinematics, frames: Mask) -> float:
    """Return the root mean square distance between markers and model [m]; NaN without a result."""
    known = found.rms[frames]
    known = known[np.isfinite(known)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def _summary(found: InverseKinematics, frames: Mask) -> str:
    rms = found.rms[frames]
    known = rms[np.isfinite(rms)]
    if not known.size:
        return "No frame has a result."
    return (
        f"{known.size} of {int(frames.sum())} frames; distance of the {len(found.marker_labels)} markers from the "
        f"model: {1e3 * _distance_m(found, frames):.1f} mm (RMS; worst frame {1e3 * known.max():.1f} mm)."
    )
