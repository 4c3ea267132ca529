"""The files of a run on markers."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.bones import BoneFile, write_bones
from marey.io.markers.results import (
    write_bone_orientations,
    write_cycle_csv,
    write_events,
    write_filled,
    write_frames,
    write_joint_csv,
    write_joint_table,
    write_marker_motion,
    write_motion_c3d,
)
from marey.io.opensim.mot_sto import write_table
from marey.markers.data.trajectories import MarkerTrajectories
from marey.pipelines.markers.estimated_bones import EstimatedBones, MethodRun
from marey.pipelines.markers.events import CycleCurves, cycle_curves
from marey.pipelines.markers.trial import MarkerTrial
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.view.pages.curves import PlotGroup
from marey.view.pages.marker_scene import MarkerPaths
from marey.view.pages.markers_report import MethodView, cycle_plots, write_markers_report

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
    cycles = [_over_cycles(run, bones) for run in bones.runs]
    with finished_together(out, inputs=bones.details.inputs) as folder:
        with progress.stage("Results"):
            _write_bones(folder, bones)
            _write_tables(folder, bones)
            if cycles[0] is not None:
                write_cycle_csv(folder / "cycles.csv", cycles[0].names, cycles[0].mean, cycles[0].spread)
            if trial.selection.filling is not None:
                write_filled(folder / "filled.csv", trial.selection.filling)
            write_motion_c3d(folder / "motion.c3d", trial.path, _all_points(trial), bones.motion)
            write_bone_orientations(
                folder / "orientations.sto", bones.time, trial.rate, bones.motion, y_up=trial.file.y_up
            )  # fmt: skip
            write_markers_report(
                folder / "report.html", title=trial.path.stem, time=bones.time, requested=bones.frames,
                methods=[_view(run) for run in bones.runs], anatomical=bones.anatomical, notes=progress.warnings,
                filled=int(trial.selection.used.filled.sum()), more=_cycle_group(bones, cycles),
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
    write_marker_motion(folder / "marker_motion.csv", bones.time, bones.markers)
    if bones.gait.events:
        write_events(folder / "events.csv", bones.gait.events)
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


def _cycle_group(bones: EstimatedBones, cycles: Sequence[CycleCurves | None]) -> list[PlotGroup]:
    """Draw the mean curves over the gait cycle, those of all methods in one plot."""
    first = cycles[0]
    if first is None:
        return []
    named = [(run.name, curves) for run, curves in zip(bones.runs, cycles, strict=True) if curves is not None]
    return [cycle_plots([(name, c.mean, c.spread) for name, c in named], first.names, first.counts)]


def _view(run: MethodRun) -> MethodView:
    return MethodView(
        name=run.name, summary=run.summary, motion=run.motion, joints=run.joints, markers=run.markers,
        seconds=run.seconds,
    )  # fmt: skip
