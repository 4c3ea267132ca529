"""Running methods on a marker trial, resumable method by method."""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from marey.arrays import Mask
from marey.errors import MareyError, SettingProblem
from marey.io.stages import Arrays
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration
from marey.markers.data.marker_motion import marker_motion
from marey.markers.data.problem import MarkerProblem
from marey.markers.kinematics.calibration_offsets import AngleOffset, joints_with_offsets, motion_with_offsets
from marey.markers.kinematics.joint_angles import (
    JointKinematics,
    joint_kinematics,
    joint_of,
    joint_point,
    turns_since,
)
from marey.markers.kinematics.landmark_motion import landmark_motion
from marey.markers.kinematics.root_angles import with_root_angles
from marey.markers.methods.methods import DEFAULT_METHOD, MethodEntry, choose_methods
from marey.pipelines.markers.estimated_bones import MethodRun
from marey.pipelines.markers.trial import ClusterTrial
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache


def run_methods(
    trial: ClusterTrial, names: Sequence[str], progress: Progress, cache: StageCache
) -> list[MethodRun]:  # fmt: skip
    """Run methods on a trial, in the given order; of `all` the default one first.

    With `all`, methods whose requirements the trial does not meet are skipped with a warning.

    Args:
        trial: The trial.
        names: Names of methods, or `all`.
        progress: Progress reporter.
        cache: Checkpoints of the run.

    Raises:
        SettingProblem: A method is unknown, or the trial lacks what it needs.
        MareyError: No method could be run.
    """
    entries, every = choose_methods(names), tuple(names) == ("all",)
    lacking = {entry.name: entry.missing_requirement(trial.problem) for entry in entries}
    for name, what in lacking.items():
        if what and not every:
            raise SettingProblem(f"The method {name} {what}. {_remedy(what)}")
    runs = []
    for entry in sorted(entries, key=lambda e: every and e.name != DEFAULT_METHOD):
        if lacking[entry.name]:
            progress.warn(f"Method {entry.name} {lacking[entry.name]}: skipped.")
            continue
        try:
            runs.append(_run(entry, trial, progress, cache))
        except MareyError as fault:
            if not every:
                raise
            progress.warn(f"Method {entry.name}: {fault}")
    if not runs:
        raise MareyError("No method could be run on this trial.")
    return runs


def _remedy(lacking: str) -> str:
    if "posture" in lacking:
        return "Add reference (--reference) with several postures."
    if "exercise" in lacking:
        return "Add exercise (--exercise)."
    return "Name the joint in [joints] of the TOML file clusters (--clusters)."


def _run(entry: MethodEntry, trial: ClusterTrial, progress: Progress, cache: StageCache) -> MethodRun:
    """Run one method, or read its checkpoint from an interrupted run."""

    def compute() -> dict[str, np.ndarray]:
        began = time.perf_counter()
        part, first = requested_part(trial.problem, trial.selection.frames)
        try:
            motion = entry.run(part)
        except np.linalg.LinAlgError as fault:
            wrong = f"The method {entry.name} finds no unique solution for these markers ({fault})."
            raise MareyError(wrong) from fault
        return _packed(widened(motion, first, len(trial)), time.perf_counter() - began)

    with progress.stage(f"Method {entry.name}"):
        motion, seconds = _unpacked(cache.arrays(f"method-{entry.name}", compute, depends=(trial.key, entry.function)))
    for note in motion.notes:
        # Several methods may have the same note; it is reported once.
        subject, colon, rest = note.partition(": ")
        start = f"{subject}, method " if colon else "Method "
        if not any(each.startswith(start) and each.endswith(f": {rest or note}") for each in progress.warnings):
            progress.warn(f"{start}{entry.name}: {rest or note}")
    return method_run(entry, trial, motion, seconds)


def method_run(entry: MethodEntry, trial: ClusterTrial, motion: BoneMotion, seconds: float) -> MethodRun:
    """Add to the poses of the bones the joint angles between them and the motion of the markers relative to them.

    Args:
        entry: The method.
        trial: The trial.
        motion: Poses of the bones in all frames of the trial.
        seconds: Computing time [s].
    """
    problem, motion = trial.problem, _only_requested(motion, trial)
    markers = marker_motion(trial.selection.used, problem.clusters, motion)
    angles = partial(_anatomical_joints, trial)
    rows: tuple[AngleOffset, ...] = ()
    if not trial.anatomical:
        joints = turns_since(motion, problem.joints, int(problem.calibration.frames[0]))
    elif trial.offsets is None:
        joints = angles(motion, problem.calibration)
    else:
        joints, rows = joints_with_offsets(motion, problem.calibration, trial.offsets, angles)
        motion = motion_with_offsets(motion, trial.offsets)
    return MethodRun(
        name=entry.name, summary=entry.summary, motion=motion, joints=joints, seconds=seconds, markers=markers,
        offsets=rows, landmarks=landmark_motion(motion, trial.held_landmarks),
    )  # fmt: skip


def _anatomical_joints(trial: ClusterTrial, motion: BoneMotion, calibration: AnatomicalCalibration) -> JointKinematics:
    """Compute the joint angles of bones with anatomical frames."""
    named = [joint_of(*pair, side=trial.side) for pair in trial.problem.joints]
    points = {joint.name: joint_point(motion, joint, calibration) for joint in named}
    return with_root_angles(joint_kinematics(motion, named, points), motion, y_up=trial.file.y_up)


def _only_requested(motion: BoneMotion, trial: ClusterTrial) -> BoneMotion:
    """Remove the poses in frames that were not requested."""
    out = ~trial.selection.frames
    if not out.any():
        return motion
    rotation, origin, covariance = (np.array(x) for x in (motion.rotation, motion.origin, motion.covariance))
    rotation[out], origin[out], covariance[out] = np.nan, np.nan, np.nan
    return replace(motion, rotation=rotation, origin=origin, covariance=covariance)


def requested_part(problem: MarkerProblem, wanted: Mask) -> tuple[MarkerProblem, int]:
    """Return the problem from the first to the last frame that is requested or has known poses, and its first frame.

    A method must not learn from other frames.

    Args:
        problem: The problem of the trial.
        wanted: (F,) true for the requested frames.
    """
    frames = np.concatenate([np.flatnonzero(wanted), problem.calibration.frames])
    first, end = int(frames.min()), int(frames.max()) + 1
    whole = problem.trajectories
    if end - first == len(whole):
        return problem, 0
    part = replace(
        whole, points=whole.points[first:end], filled=whole.filled[first:end], residuals=whole.residuals[first:end],
        start_s=whole.start_s + first / whole.rate,
    )  # fmt: skip
    known = replace(problem.calibration, frames=problem.calibration.frames - first)
    return replace(problem, trajectories=part, calibration=known), first


def widened(motion: BoneMotion, first: int, frames: int) -> BoneMotion:
    """Extend a motion to all frames of the trial; frames that were not estimated are NaN.

    Args:
        motion: Over some successive frames.
        first: The first of them.
        frames: Number of frames of the trial.
    """
    if len(motion) == frames:
        return motion
    wide = []
    for values in (motion.rotation, motion.origin, motion.covariance):
        wide.append(np.full((frames, *values.shape[1:]), np.nan))
        wide[-1][first : first + len(motion)] = values
    return replace(motion, rotation=wide[0], origin=wide[1], covariance=wide[2])


def _packed(motion: BoneMotion, seconds: float) -> dict[str, np.ndarray]:
    return {
        "segments": np.array(motion.segments, np.str_), "notes": np.array(motion.notes, np.str_),
        "rotation": motion.rotation, "origin": motion.origin, "covariance": motion.covariance,
        "seconds": np.array(seconds),
    }  # fmt: skip


def _unpacked(arrays: Arrays) -> tuple[BoneMotion, float]:
    motion = BoneMotion(
        segments=tuple(map(str, arrays["segments"])), notes=tuple(map(str, arrays["notes"])),
        rotation=arrays["rotation"], origin=arrays["origin"], covariance=arrays["covariance"],
    )  # fmt: skip
    return motion, float(arrays["seconds"])
