"""`marey markers`: from the skin markers of a trial to the motion of bones."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.arrays import Mask
from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.markers.results import is_y_up
from marey.io.stages import Arrays, file_fingerprint
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import Cluster
from marey.markers.data.marker_motion import marker_motion
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import joint_kinematics, joint_of, turns_since
from marey.markers.methods.methods import DEFAULT_METHOD, MethodEntry, choose_methods
from marey.pipelines.markers.events import Gait, find_gait
from marey.pipelines.markers.model import read_model_trial
from marey.pipelines.markers.results import MarkersResults, MethodRun, write_results
from marey.pipelines.markers.settings import MarkersOptions
from marey.pipelines.markers.trial import MarkersTrial, read_trial
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache


def markers(path: Path, options: MarkersOptions, progress: Progress) -> Path:
    """Estimate the motion of the bones beneath the markers of a trial, and write it.

    Args:
        path: A C3D, TRC or CSV.
        options: What is asked for.
        progress: Is told, and keeps timings and warnings.

    Returns:
        The folder with the results.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: A setting is impossible.
    """
    if not path.is_file():
        raise FileProblem(path, "is a folder" if path.is_dir() else "does not exist", "Give a C3D, TRC or CSV.")
    if options.model is not None:
        return follow_model(path, options, progress)
    entries = choose_methods(options.methods or (DEFAULT_METHOD,))
    out = options.out or path.with_name(f"{path.stem}_marey")
    named = [path, *options.files]
    with threadpool_limits(1), StageCache(out, [file_fingerprint(each) for each in named]) as cache:
        with progress.stage("Reading"):
            trial = read_trial(path, options)
        for note in trial.notes:
            progress.warn(note)
        runs = run_methods(trial, entries, progress, cache, many=options.methods == ("all",))
        gait = _gait(path, trial.measured, trial.problem.clusters, trial.side, progress)
        results = MarkersResults(
            gait=gait, path=path, measured=trial.measured, used=trial.used, filling=trial.filling, asked=trial.asked,
            runs=runs, anatomical=trial.anatomical, side=trial.side,
            reference_frames=trial.problem.calibration.frames,
        )  # fmt: skip
        write_results(results, options, out, progress)
    for line in told(results):
        progress.say(line)
    return out


def run_methods(
    trial: MarkersTrial, entries: Sequence[MethodEntry], progress: Progress, cache: StageCache, *, many: bool
) -> list[MethodRun]:
    """Run methods on a trial, in the order in which they were asked for; of `all` the default one first.

    Of `all`, those that the trial lacks something for are passed over, and said.

    Raises:
        SettingProblem: A method that was asked for by name needs what the trial does not give.
        MareyError: No method could be run.
    """
    runs, problem = [], trial.problem
    lacking = {entry.name: entry.missing_requirement(problem) for entry in entries}
    for name, what in lacking.items():
        if what and not many:
            raise SettingProblem(f"--method {name} {what}. {_remedy(what)}")
    for entry in sorted(entries, key=lambda e: many and e.name != DEFAULT_METHOD):
        if lacking[entry.name]:
            progress.warn(f"Method {entry.name}: {lacking[entry.name]}; passed over.")
            continue
        try:
            runs.append(_run(entry, trial, problem, progress, cache))
        except MareyError as fault:
            if not many:
                raise
            progress.warn(f"Method {entry.name}: {fault}")
    if not runs:
        raise MareyError("No method could be run on this trial.")
    return runs


def _remedy(lacking: str) -> str:
    if "posture" in lacking:
        return "Give a --reference with several postures."
    if "exercise" in lacking:
        return "Give one with --exercise."
    return "Name it in [joints] of the TOML given with --clusters."


def _run(
    entry: MethodEntry, trial: MarkersTrial, problem: MarkerProblem, progress: Progress, cache: StageCache
) -> MethodRun:
    """Run one method, or find what an interrupted run left of it."""

    def compute() -> dict[str, np.ndarray]:
        began = time.perf_counter()
        part, first = asked_part(problem, trial.asked)
        try:
            motion = entry.run(part)
        except np.linalg.LinAlgError as fault:
            wrong = f"The method {entry.name} finds no single solution for these markers ({fault})."
            raise MareyError(wrong) from fault
        return _packed(widened(motion, first, len(trial.asked)), time.perf_counter() - began)

    with progress.stage(f"Method {entry.name}"):
        motion, seconds = _unpacked(cache.arrays(f"method-{entry.name}", compute, depends=(trial.key, entry.function)))
    for note in motion.notes:
        # What several methods have to say alike is said once.
        if not any(warning.endswith(f": {note}") for warning in progress.warnings):
            progress.warn(f"Method {entry.name}: {note}")
    return finished_run(entry.name, entry.summary, trial, motion, seconds)


def finished_run(name: str, summary: str, trial: MarkersTrial, motion: BoneMotion, seconds: float) -> MethodRun:
    """Add to a motion of bones the joints between them and the markers' motion over them."""
    motion = _only_asked(motion, trial)
    if trial.anatomical:
        joints = joint_kinematics(motion, [joint_of(*pair, side=trial.side) for pair in trial.problem.joints])
    else:
        joints = turns_since(motion, trial.problem.joints, int(trial.problem.calibration.frames[0]))
    return MethodRun(
        name=name, summary=summary, motion=motion, joints=joints, seconds=seconds,
        markers=marker_motion(trial.used, trial.problem.clusters, motion),
    )  # fmt: skip


def _only_asked(motion: BoneMotion, trial: MarkersTrial) -> BoneMotion:
    """Leave nothing in frames that were not asked for, whatever a method knows of them."""
    out = ~trial.asked
    if not out.any():
        return motion
    rotation, origin, covariance = (np.array(x) for x in (motion.rotation, motion.origin, motion.covariance))
    rotation[out], origin[out], covariance[out] = np.nan, np.nan, np.nan
    return replace(motion, rotation=rotation, origin=origin, covariance=covariance)


def asked_part(problem: MarkerProblem, asked: Mask) -> tuple[MarkerProblem, int]:
    """Give the problem over the frames that are asked for and those in which the bones are known, and its first frame.

    A method is not to count, or to learn from, frames that nobody asked for.
    """
    frames = np.concatenate([np.flatnonzero(asked), problem.calibration.frames])
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
    """Put a motion back among all frames of the trial, empty where it was not looked at."""
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


def follow_model(path: Path, options: MarkersOptions, progress: Progress) -> Path:
    """Follow the markers with an OpenSim model, all its bodies at once, and write its coordinates and bodies.

    Raises:
        FileProblem: A file cannot be used, or model, tasks and trial have no marker in common.
    """
    out = options.out or path.with_name(f"{path.stem}_marey")
    with threadpool_limits(1), StageCache(out, [file_fingerprint(each) for each in (path, *options.files)]):
        with progress.stage("Reading"):
            ready = read_model_trial(path, options)
        for note in ready.notes:
            progress.warn(note)
        with progress.stage("Following the model"):
            began = time.perf_counter()
            found = ready.follow()
            seconds = time.perf_counter() - began
        for note in found.notes:
            progress.warn(note)
        run = MethodRun(
            name="model", summary=f"the OpenSim model {options.model.name if options.model else ''}", seconds=seconds,
            motion=found.bones, joints=found.coordinates,
            markers=marker_motion(ready.used, ready.clusters, found.bones),
        )  # fmt: skip
        gait = _gait(path, ready.measured, ready.clusters, None, progress)
        results = MarkersResults(
            gait=gait, path=path, measured=ready.measured, used=ready.used, filling=ready.filling, asked=ready.asked,
            runs=[run], coordinates=found.table,
        )  # fmt: skip
        write_results(results, options, out, progress)
    progress.say(found.told)
    return out


def _gait(
    path: Path, measured: MarkerTrajectories, clusters: Sequence[Cluster], side: str | None, progress: Progress
) -> Gait:
    """Find the events of the trial and say how they were found."""
    gait = find_gait(path, measured, clusters, side=side, y_up=is_y_up(path))
    for note in gait.notes:
        progress.warn(note)
    return gait


def told(results: MarkersResults) -> list[str]:
    """Say in a few lines what was found."""
    runs, first = results.runs, results.runs[0]
    lines = []
    for s, name in enumerate(first.motion.segments):
        known = int(first.motion.answered[:, s].sum())
        moved = first.markers.rms[[segment == name for segment in first.markers.segments]]
        moved = moved[np.isfinite(moved)]
        skin = f", its markers move {1e3 * np.sqrt(np.mean(moved**2)):.1f} mm over it (RMS)" if len(moved) else ""
        lines.append(f"{name}: {known} of {int(results.asked.sum())} frames{skin}.")
    if len(runs) > 1:
        lines.append(f"Methods: {', '.join(run.name for run in runs)}; the files hold {first.name}.")
    return lines
