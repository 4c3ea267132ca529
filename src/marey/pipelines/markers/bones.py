"""The motion of bones beneath skin markers, as a labelled result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from marey.arrays import Mask
from marey.errors import FileProblem, SettingProblem
from marey.io.markers.bones import read_bones
from marey.io.markers.reading_results import read_event_csv, read_joint_csv, read_marker_motion
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import MarkerMotion
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.methods.methods import METHODS
from marey.motion.gait import gait_cycles
from marey.pipelines.markers.estimated_bones import EstimatedBones, MethodRun
from marey.pipelines.markers.events import Gait
from marey.pipelines.markers.results import write_results
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import RunDetails, copy_results

if TYPE_CHECKING:
    pass

COMMAND = "markers"
"""The command that leaves the same files."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Bones(EstimatedBones):
    """The motion of the bones beneath the markers of a trial, by one method or several.

    Values of the first method are the result's own; `method` gives those of another one.

    Example:
        >>> import marey
        >>> walk = marey.open_markers("walk.c3d", reference="walk_frame0.npz")  # doctest: +SKIP
        >>> bones = marey.estimate_bones(walk)  # doctest: +SKIP
        >>> bones.to_pandas()["knee_flexion_deg"].max()  # doctest: +SKIP
    """

    def method(self, name: str) -> "Bones":
        """Return the same result with the values of another method.

        Args:
            name: One of `methods`.

        Raises:
            SettingProblem: The method was not run.
        """
        for run in self.runs:
            if run.name == name:
                return replace(self, runs=(run, *(other for other in self.runs if other is not run)))
        raise SettingProblem(f"There are no bones of the method {name!r}. There are: {', '.join(self.methods)}.")

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        head = f"Bones of {', '.join(self.segments)}: {len(self)} frames at {self.rate:g} Hz, method {self.methods[0]}"
        return "\n".join([f"<{head}", *(f"  {line}" for line in self.summary())]) + ">"

    def summary(self) -> list[str]:
        """Return a line per bone: frames with a pose, and the motion of the skin over it."""
        lines, run = [], self.runs[0]
        if run.fit:
            return [run.fit]
        for s, name in enumerate(run.motion.segments):
            known = int(run.motion.answered[:, s].sum())
            moved = run.markers.rms[[segment == name for segment in run.markers.segments]]
            moved = moved[np.isfinite(moved)]
            skin = f"; its markers move {1e3 * np.sqrt(np.mean(moved**2)):.1f} mm over it (RMS)" if len(moved) else ""
            lines.append(f"{name}: {known} of {int(self.frames.sum())} frames{skin}.")
        if len(self.runs) > 1:
            lines.append(f"Methods: {', '.join(self.methods)}; the files have the result of {self.methods[0]}.")
        return lines

    def save(self, folder: Path | str, *, progress: Progress | None = None) -> Path:
        """Write the files of `marey markers`: tables, C3D, report and run.json.

        A result that was read from a folder is copied from there.

        Args:
            folder: Where the files are written; it is made if it does not exist.
            progress: Progress reporter.

        Returns:
            The folder.
        """
        folder = Path(folder)
        if self.folder is not None:
            copy_results(self.folder, folder, COMMAND)
        else:
            write_results(self, folder, progress or self.details.resumed_progress())
        return folder


def load_bones(folder: Path | str) -> Bones:
    """Read the results of `marey markers`, or of `Bones.save`.

    Args:
        folder: A folder with `bones.npz`, and the tables beside it.

    Returns:
        The result. Joint angles and the motion of the markers are those of the first method; the files of further
        methods have only the poses of the bones.

    Raises:
        FileProblem: A file is missing or damaged.

    Example:
        >>> import marey
        >>> bones = marey.load_bones("walk_marey")  # doctest: +SKIP
    """
    folder = Path(folder)
    if not (folder / "bones.npz").is_file():
        raise FileProblem(folder, "has no bones.npz", "Give a folder with the results of `marey markers`.")
    held = read_bones(folder / "bones.npz")
    details = RunDetails.read(folder, COMMAND)
    listed = details.settings.get("methods", ())
    first, *others = [str(name) for name in listed] if isinstance(listed, Sequence) and listed else ["unknown"]
    tables = folder / "angles.csv", folder / "marker_motion.csv", folder / "events.csv"
    joints = read_joint_csv(tables[0]) if tables[0].is_file() else _no_joints(len(held.time))
    markers = read_marker_motion(tables[1]) if tables[1].is_file() else _no_markers(len(held.time))
    events = read_event_csv(tables[2]) if tables[2].is_file() else ()
    runs = [_run(first, held.motion, joints, markers)]
    for name in others:
        motion = read_bones(folder / f"bones_{name}.npz").motion
        runs.append(_run(name, motion, _no_joints(len(motion)), _no_markers(len(motion))))
    return Bones(
        runs=tuple(runs), time=held.time, frames=_frames(details.settings, len(held.time)),
        gait=Gait(events=events, cycles=gait_cycles(events), notes=(), plates={}),
        anatomical=any(key in details.settings for key in ("reference", "static", "model")), side=held.side,
        reference_frames=held.reference_frames, details=details, folder=folder,
    )  # fmt: skip


def _run(name: str, motion: BoneMotion, joints: JointKinematics, markers: MarkerMotion) -> MethodRun:
    summary = METHODS[name].summary if name in METHODS else ""
    return MethodRun(
        name=name, summary=summary, motion=motion, joints=joints, markers=markers, seconds=float("nan")
    )  # fmt: skip


def _frames(settings: Any, count: int) -> Mask:
    """Return the frames (F,) that the settings in run.json select."""
    frames = np.ones(count, bool)
    limits = settings.get("frames")
    if isinstance(limits, list) and len(limits) == 2:
        frames[: int(limits[0])] = False
        frames[int(limits[1]) :] = False
    return frames


def _no_joints(frames: int) -> JointKinematics:
    none = np.zeros((frames, 0))
    return JointKinematics(
        angle_names=(), angles=none, angles_sd=none, translations=none, translations_sd=none
    )  # fmt: skip


def _no_markers(frames: int) -> MarkerMotion:
    return MarkerMotion(labels=(), segments=(), places=np.zeros((frames, 0, 3)))
