"""The files of a run on markers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Integers, Mask
from marey.io.markers.bones import BoneFile, write_bones
from marey.io.markers.results import (
    is_y_up,
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
from marey.io.opensim.mot_sto import Table, write_table
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import MarkerMotion
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.preprocessing.gaps import FilledGaps
from marey.pipelines.markers.events import CycleCurves, Gait, cycle_curves
from marey.pipelines.markers.settings import MarkersOptions
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import finished_together, write_record
from marey.view.pages.curves import PlotGroup
from marey.view.pages.markers_report import MethodView, cycle_plots, write_markers_report


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodRun:
    """What one method made of the trial."""

    name: str
    summary: str
    motion: BoneMotion
    joints: JointKinematics
    markers: MarkerMotion
    seconds: float
    """How long it took; of the run in which it was computed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkersResults:
    """What a run on markers found."""

    path: Path
    """The trial."""
    measured: MarkerTrajectories
    """As the file has them."""
    used: MarkerTrajectories
    """With what was filled."""
    filling: FilledGaps | None = None
    """How, where gaps were to be filled."""
    asked: Mask
    """(F,) the frames that were estimated."""
    runs: Sequence[MethodRun]
    """The first one's results are the run's."""
    gait: Gait
    """Events and cycles; empty where there are none."""
    anatomical: bool = True
    """Whether the bones' frames are anatomical ones."""
    side: str | None = None
    """`left` or `right` where it is known and the segments' names do not tell."""
    reference_frames: Integers | None = None
    """(K,) frames of the trial in which the bones were known; None of a model's."""
    coordinates: Table | None = None
    """Coordinates of a model, for angles.mot instead of the joints between bones."""


def write_results(results: MarkersResults, options: MarkersOptions, out: Path, progress: Progress) -> None:
    """Write all results at once: those of the first method, and the bones of every other one beside them.

    Args:
        results: What was found.
        options: As asked.
        out: Where.
        progress: Knows timings and warnings.
    """
    runs, first = results.runs, results.runs[0]
    time, rate = results.measured.time, results.measured.rate
    asked = {**{k: v for k, v in vars(options).items() if v not in (None, ())}, "methods": [run.name for run in runs]}
    with finished_together(out) as folder:
        with progress.stage("Results"):
            for run in runs:
                name = "bones.npz" if run is first else f"bones_{run.name}.npz"
                known = results.reference_frames
                write_bones(
                    folder / name, BoneFile(motion=run.motion, time=time, side=results.side, reference_frames=known)
                )  # fmt: skip
            if results.coordinates is not None:
                write_table(folder / "angles.mot", results.coordinates)
            elif first.joints.angle_names:
                write_joint_table(folder / "angles.mot", time, first.joints)
            if first.joints.angle_names:
                write_joint_csv(folder / "angles.csv", time, first.joints)
            write_marker_motion(folder / "marker_motion.csv", time, first.markers)
            if results.gait.events:
                write_events(folder / "events.csv", results.gait.events)
            if results.gait.plates:
                write_frames(folder / "frames.json", results.gait.plates)
            cycles = _cycles(results)
            if cycles and cycles[0] is not None:
                write_cycle_csv(folder / "cycles.csv", cycles[0].names, cycles[0].mean, cycles[0].spread)
            if results.filling is not None:
                write_filled(folder / "filled.csv", results.filling)
            write_motion_c3d(folder / "motion.c3d", results.path, _all_points(results), first.motion)
            write_bone_orientations(
                folder / "orientations.sto", time, rate, first.motion, y_up=is_y_up(results.path)
            )  # fmt: skip
            write_markers_report(
                folder / "report.html", title=results.path.stem, time=time, asked=results.asked,
                methods=[_view(run) for run in runs], anatomical=results.anatomical, notes=progress.warnings,
                filled=int(results.used.filled.sum()), more=_cycle_group(results, cycles), timings=progress.timings,
                settings=asked, of_model=results.coordinates is not None,
            )  # fmt: skip
        write_record(
            folder, command="markers", settings=asked, inputs=[results.path, *options.files], root=results.path.parent,
            progress=progress,
        )  # fmt: skip


def _all_points(results: MarkersResults) -> MarkerTrajectories:
    """Give what was filled, and what was measured also in frames that were not asked for."""
    known = np.isfinite(results.used.points)
    return replace(results.used, points=np.where(known, results.used.points, results.measured.points))


def _cycles(results: MarkersResults) -> list[CycleCurves | None]:
    """Put every method's joints over the cycles."""
    if not results.gait.cycles:
        return []
    time = results.measured.time
    return [cycle_curves(run.joints, time, results.gait.cycles, side=results.side) for run in results.runs]


def _cycle_group(results: MarkersResults, cycles: Sequence[CycleCurves | None]) -> list[PlotGroup]:
    """Draw the mean curves over the cycle, all methods over each other."""
    first = cycles[0] if cycles else None
    if first is None:
        return []
    named = [(run.name, curves) for run, curves in zip(results.runs, cycles, strict=True) if curves is not None]
    return [cycle_plots([(name, c.mean, c.spread) for name, c in named], first.names, first.counts)]


def _view(run: "MethodRun") -> MethodView:
    return MethodView(
        name=run.name, summary=run.summary, motion=run.motion, joints=run.joints, markers=run.markers,
        seconds=run.seconds,
    )  # fmt: skip
