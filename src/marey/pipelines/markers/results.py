"""The files of a run on markers."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.bones import BoneFile, write_bones
from marey.io.markers.given_angles import write_given_agreement, write_given_angles
from marey.io.markers.results import (
    write_angle_offsets,
    write_bone_orientations,
    write_filled,
    write_frames,
    write_joint_csv,
    write_joint_table,
    write_landmark_motion,
    write_marker_motion,
    write_motion_c3d,
    write_static_landmarks,
)
from marey.io.opensim.mot_sto import write_table
from marey.markers.data.trajectories import MarkerTrajectories
from marey.motion.events.curves import CycleCurves
from marey.motion.events.cycles import GIVEN
from marey.pipelines.gait.files import cycle_group, gait_tables, write_gait
from marey.pipelines.gait.repetitions import save_repetitions
from marey.pipelines.markers.estimated_bones import EstimatedBones, MethodRun
from marey.pipelines.markers.events import cycle_curves
from marey.pipelines.markers.static import LANDMARK_SD_M
from marey.pipelines.markers.trial import MarkerTrial
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.view.gait.assumed_table import assumed_table
from marey.view.gait.given_angles import given_angle_plots, given_angle_table
from marey.view.gait.repetition_table import repetition_tables
from marey.view.pages.marker_scene import MarkerPaths
from marey.view.pages.markers_report import MethodView, write_markers_report

GIVEN_ANGLES = "given_angles.csv"
"""Name of the file with the angles that another program wrote into the trial."""
LANDMARK_MOTION = "landmark_motion.csv"
"""Name of the file with the paths of the landmarks."""
RESULTS = ("report.html", "bones.npz", "marker_motion.csv", "motion.c3d")
"""Files that every run writes, whose names are checked before the work."""


def write_results(bones: EstimatedBones, out: Path, progress: Progress) -> None:
    """Write all files at once: those of the first method, and the bones of every other one beside them.

    Args:
        bones: A result that was estimated, not one that was read.
        out: The folder.
        progress: Progress reporter; its times and warnings are in the report.
    """
    trial = bones.trial
    assert trial is not None
    given = bones.given_agreement
    cycles = [(run.name, _over_cycles(run, bones)) for run in bones.runs]
    with finished_together(out, inputs=bones.details.inputs) as folder:
        with progress.stage("Results"):
            _write_bones(folder, bones)
            _write_tables(folder, bones)
            write_gait(folder, bones.gait, cycles[0][1])
            save_repetitions(folder, bones.repetitions)
            if trial.selection.filling is not None:
                write_filled(folder / "filled.csv", trial.selection.filling)
            new = [event for event in bones.gait.events if event.source != GIVEN]
            write_motion_c3d(
                folder / "motion.c3d", trial.path, _all_points(trial), bones.motion, new,
                person=trial.file.name, renamed=trial.file.renamed,
                computed=[label for cluster in trial.clusters for label in cluster.computed],
            )  # fmt: skip
            write_bone_orientations(
                folder / "orientations.sto", bones.time, trial.rate, bones.motion, y_up=trial.file.y_up
            )  # fmt: skip
            write_markers_report(
                folder / "report.html", title=trial.path.stem, time=bones.time, requested=bones.frames,
                methods=[_view(run) for run in bones.runs], anatomical=bones.anatomical, notes=progress.warnings,
                filled=int(trial.selection.used.filled.sum()),
                more=[*given_angle_plots(bones.joints, bones.given_angles, given), *cycle_group(bones.gait, cycles)],
                more_tables=[
                    *assumed_table(bones.runs[0].offsets), *gait_tables(bones.gait),
                    *repetition_tables(bones.repetitions), *given_angle_table(given),
                ],
                timings=progress.timings, settings=bones.details.settings, of_model=bones.coordinates is not None,
                head=page_head(bones.details.command, bones.verdict), paths=_paths(trial),
            )  # fmt: skip
        write_record(
            folder, command=bones.details.command, settings=bones.details.settings, inputs=bones.details.inputs,
            root=bones.details.root, progress=progress, verdict=bones.verdict,
        )  # fmt: skip


def _write_bones(folder: Path, bones: EstimatedBones) -> None:
    for run in bones.runs:
        name = "bones.npz" if run is bones.runs[0] else f"bones_{run.name}.npz"
        held = BoneFile(
            motion=run.motion, time=bones.time, side=bones.side, reference_frames=bones.reference_frames
        )  # fmt: skip
        write_bones(folder / name, held)


def _write_tables(folder: Path, bones: EstimatedBones) -> None:
    if bones.coordinates is not None:
        write_table(folder / "angles.mot", bones.coordinates)
    elif bones.joints.angle_names:
        write_joint_table(folder / "angles.mot", bones.time, bones.joints)
    if bones.joints.angle_names:
        write_joint_csv(folder / "angles.csv", bones.time, bones.joints)
    if bones.runs[0].offsets:
        write_angle_offsets(folder / "assumed.csv", bones.runs[0].offsets)
    if bones.given_angles is not None:
        write_given_angles(folder / GIVEN_ANGLES, bones.time, bones.given_angles)
        if bones.given_agreement:
            write_given_agreement(folder / "given_agreement.csv", bones.given_agreement)
    write_marker_motion(folder / "marker_motion.csv", bones.time, bones.markers)
    if bones.trial is not None and bones.trial.landmarks:
        write_static_landmarks(folder / "landmarks.csv", bones.trial.landmarks, sd_m=LANDMARK_SD_M)
    if bones.runs[0].landmarks.names:
        write_landmark_motion(folder / LANDMARK_MOTION, bones.time, bones.runs[0].landmarks)
    if bones.gait.plates:
        write_frames(folder / "frames.json", bones.gait.plates)


def _all_points(trial: MarkerTrial) -> MarkerTrajectories:
    """Return the filled points and all measured ones, also those in frames that were not requested."""
    used, measured = trial.selection.used, trial.file.trajectories
    return replace(used, points=np.where(np.isfinite(used.points), used.points, measured.points))


def _paths(trial: MarkerTrial) -> MarkerPaths:
    """Return the markers for the 3-D view of the page."""
    points = _all_points(trial)
    return MarkerPaths(
        labels=points.labels, points=points.points, filled=points.filled,
        upright=OPENSIM_FROM_WORLD.T if trial.file.y_up else np.eye(3),
    )  # fmt: skip


def _over_cycles(run: MethodRun, bones: EstimatedBones) -> CycleCurves | None:
    """Average one method's joint angles over the gait cycles; None if there are no cycles."""
    return cycle_curves(run.joints, bones.time, bones.gait.cycles, side=bones.side) if bones.gait.cycles else None


def _view(run: MethodRun) -> MethodView:
    return MethodView(
        name=run.name, summary=run.summary, motion=run.motion, joints=run.joints, markers=run.markers,
        seconds=run.seconds,
    )  # fmt: skip
