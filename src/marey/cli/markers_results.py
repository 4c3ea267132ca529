"""The files of a run on markers."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from marey.cli.markers_settings import MarkersOptions
from marey.cli.markers_trial import MarkersTrial
from marey.cli.progress import Progress
from marey.cli.run_record import finished_together, write_record
from marey.io.bones import BoneFile, write_bones
from marey.io.marker_results import (
    is_y_up,
    write_bone_orientations,
    write_joint_csv,
    write_joint_table,
    write_marker_motion,
    write_motion_c3d,
)
from marey.view.markers import MethodView, write_markers_report

if TYPE_CHECKING:
    from marey.cli.markers import MethodRun


def write_results(
    trial: MarkersTrial, runs: Sequence["MethodRun"], options: MarkersOptions, out: Path, progress: Progress
) -> None:
    """Write all results at once: those of the first method, and the bones of every other one beside them.

    Args:
        trial: What was measured.
        runs: The first one's results are the run's.
        options: As asked.
        out: Where.
        progress: Knows timings and warnings.
    """
    first, measured = runs[0], trial.measured
    time, rate = measured.time, measured.rate
    asked = {**{k: v for k, v in vars(options).items() if v not in (None, ())}, "methods": [run.name for run in runs]}
    with finished_together(out) as folder:
        with progress.stage("Results"):
            for run in runs:
                name = "bones.npz" if run is first else f"bones_{run.name}.npz"
                write_bones(folder / name, BoneFile(motion=run.motion, time=time, side=trial.side))
            if first.joints.angle_names:
                write_joint_table(folder / "angles.mot", time, first.joints)
                write_joint_csv(folder / "angles.csv", time, first.joints)
            write_marker_motion(folder / "marker_motion.csv", time, first.markers)
            write_motion_c3d(folder / "motion.c3d", trial.path, trial.used, first.motion)
            write_bone_orientations(
                folder / "orientations.sto", time, rate, first.motion, y_up=is_y_up(trial.path)
            )  # fmt: skip
            write_markers_report(
                folder / "report.html", title=trial.path.stem, time=time, asked=trial.asked,
                methods=[_view(run) for run in runs], anatomical=trial.anatomical, notes=progress.warnings,
                filled=int(trial.used.filled.sum()), timings=progress.timings, settings=asked,
            )  # fmt: skip
        write_record(
            folder, command="markers", settings=asked, inputs=[trial.path, *options.files], root=trial.path.parent,
            progress=progress,
        )  # fmt: skip


def _view(run: "MethodRun") -> MethodView:
    return MethodView(
        name=run.name, summary=run.summary, motion=run.motion, joints=run.joints, markers=run.markers,
        seconds=run.seconds,
    )  # fmt: skip


def share_text(values: np.ndarray) -> str:
    """Write a share as percent."""
    return f"{100 * float(np.mean(values)):.1f} %" if np.size(values) else "none"
