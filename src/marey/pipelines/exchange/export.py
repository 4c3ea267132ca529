"""`marey export`: results of a recording in the forms in which laboratories and archives exchange them."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import marey
from marey.errors import FileProblem, SettingProblem
from marey.io.markers.c3d_angles import angle_points
from marey.io.results.complete_c3d import write_body_c3d, write_c3d_with_angles
from marey.io.results.gait import read_event_csv
from marey.io.results.motion_bids import RecordingLabels, write_motion_bids
from marey.io.results.movement import write_movement
from marey.motion.motion import BodyMotion
from marey.pipelines.capture.motion import load_motion, motion_file
from marey.pipelines.exchange.bids import body_channels, bone_channels
from marey.pipelines.exchange.opensim import OpenSimOptions, export_opensim
from marey.pipelines.exchange.poses import poses_of_bones, poses_of_people
from marey.pipelines.markers.bones import Bones, load_bones
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.values import issue_warnings

TARGETS = {"bids": "", "movement": ".nc", "movement-0.17": ".nc", "c3d": ".c3d", "opensim": ""}
"""Forms of exchange, and the ending of those that are a single file: a Motion-BIDS dataset, a poses dataset of
`movement` before and from version 0.17, a C3D, and a folder with the user's scaled OpenSim model."""
_BONES = "bones.npz"
"""The file of results of `marey markers`."""
_AXES = "world: right-handed, Z up"
"""Axes of captured motions."""
_MARKER_AXES = "those of the marker file"
"""Axes of bones from markers."""


def export(
    results: Path | str, *, out: Path | str, to: str = "bids", subject: str = "01", task: str | None = None,
    session: str | None = None, run: int | None = None, model: Path | str | None = None,
    joints: Path | str | None = None, mass_kg: float | None = None,
    forces: Path | str | None = None, clock: Path | str | None = None, progress: Progress | None = None,
) -> Path:  # fmt: skip
    """Write the results of a recording in a form for exchange, as `marey export` does.

    Args:
        results: Results of `marey capture`, `marey shape` or `marey markers`.
        out: Folder of the dataset (`bids`), which is begun if it does not exist, and to which recordings are added;
            folder for the files (`opensim`); or the file (the other forms), which should not exist.
        to: `bids`: Motion-BIDS; `movement`, `movement-0.17`: a poses dataset of the package `movement`, also of several
            people, with the dimensions `keypoints` and `individuals` or, from 0.17 on, `keypoint` and `individual`;
            `c3d`: a C3D with points, rotations, joint angles and events; `opensim`: your own OpenSim model, scaled to
            the person.
        subject: Label of the person: letters and digits.
        task: Label of the task, for `bids`; the name of the recording by default.
        session: Label of the session, if there are several, for `bids`.
        run: Number of the repetition, if there are several, for `bids`.
        model: Your OpenSim model (`.osim`), for `opensim`.
        joints: TOML with the joints of the model that its bodies' names do not indicate, for `opensim`.
        mass_kg: Mass of the person [kg], for `opensim`; that of the recording, or an estimate, by default.
        forces: C3D with force plates in the laboratory of the results, for `opensim`; by default that of a marker
            trial.
        clock: The `clock.json` that `marey device` wrote for `forces`, for `opensim`; by default its clock is that of
            the results.
        progress: Progress reporter, which notes what was assumed; None issues the notes as Python warnings.

    Returns:
        The file with the values; the scaled model for `opensim`.

    Raises:
        SettingProblem: The form is unknown, or a label has other characters than letters and digits.
        FileProblem: The results cannot be read, the folder holds something else, or the recording exists.

    Example:
        >>> import marey
        >>> marey.export("walk01/marey", out="dataset", subject="01", task="walk")
        PosixPath('dataset/sub-01/motion/sub-01_task-walk_tracksys-marey_motion.tsv')
    """
    if to not in TARGETS:
        raise SettingProblem(f"The form is {to!r} and should be one of: {', '.join(TARGETS)}.")
    results, out = Path(results), Path(out)
    if to != "opensim" and any(given is not None for given in (model, joints, mass_kg, forces, clock)):
        raise SettingProblem(f"Model, joints, mass, forces and clock belong to the form opensim, and not to {to}.")
    labels = RecordingLabels(subject=subject, task=task or _task(results), session=session, run=run)
    if to == "bids":
        return _export_bids(results, out, labels)
    if task is not None or session is not None or run is not None:
        raise SettingProblem(f"Task, session and run belong to the form bids, and not to {to}.")
    if to == "opensim":
        if model is None:
            raise SettingProblem("The form opensim needs your OpenSim model (--model FILE.osim).")
        options = OpenSimOptions(
            model=Path(model), joints=None if joints is None else Path(joints), mass_kg=mass_kg,
            forces=None if forces is None else Path(forces), clock=None if clock is None else Path(clock),
        )  # fmt: skip
        reporter = RecordingProgress() if progress is None else progress
        path = export_opensim(results, out, options, reporter)
        if progress is None:
            issue_warnings(reporter)
        return path
    _check_file(out, TARGETS[to])
    if to == "c3d":
        return _export_c3d(results, out)
    return _export_movement(results, out, subject, singular=to == "movement-0.17")


def _check_file(out: Path, ending: str) -> None:
    """Raise if a file cannot be written under this name, or exists."""
    if out.suffix.lower() != ending:
        raise FileProblem(out, f"does not end in {ending}", "Give the name of the file to write.")
    if out.exists():
        raise FileProblem(out, "exists", "Give another name.")
    if not out.resolve().parent.is_dir():
        raise FileProblem(out.parent, "is not a folder", "Give a file in a folder that exists.")


def _export_bids(results: Path, out: Path, labels: RecordingLabels) -> Path:
    if (results / _BONES).is_file():
        bones = load_bones(results)
        channels, rate = tuple(bone_channels(bones)), bones.rate
    else:
        motion = load_motion(motion_file(results)).data
        channels, rate = tuple(body_channels(motion)), motion.rate
    _check_rate(results, rate)
    return write_motion_bids(out, labels, channels, rate=rate, version=marey.__version__)


def _export_movement(results: Path, out: Path, subject: str, *, singular: bool) -> Path:
    if (results / _BONES).is_file():
        bones = load_bones(results)
        tracks, axes = poses_of_bones(bones, person=subject), _MARKER_AXES
    else:
        tracks, axes = poses_of_people(_people(results, subject), results=results), _AXES
    _check_rate(results, tracks.rate)
    more = {"axes": axes, "space_unit": "m", "source_file": str(results)}
    source = f"marey {marey.__version__}"
    write_movement(out, tracks, source=source, attributes=more, singular=singular)
    return out


def _people(results: Path, subject: str) -> Mapping[str, BodyMotion]:
    """Return the motion of the person, or those of all people in `person1`, `person2`, ... of one recording."""
    for folder in (results, results / "marey"):
        names = {path.parent.name: path for path in folder.glob("person*/motion.npz")}
        numbers = sorted(int(name[6:]) for name in names if name[6:].isdigit())
        if numbers and not (folder / "motion.npz").is_file():
            return {f"person{n}": load_motion(names[f"person{n}"]).data for n in numbers}
    return {subject: load_motion(motion_file(results)).data}


def _export_c3d(results: Path, out: Path) -> Path:
    if (results / _BONES).is_file():
        bones = load_bones(results)
        write_c3d_with_angles(out, results / "motion.c3d", angle_points(*_curves(bones)))
        return out
    file = motion_file(results)
    motion = load_motion(file).data
    events = file.parent / "events.csv"
    write_body_c3d(
        out, motion, angles=angle_points(motion.angle_names, motion.angles_deg, motion.angles_deg_sd),
        events=read_event_csv(events) if events.is_file() else (),
    )  # fmt: skip
    return out


def _curves(bones: Bones) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return the names of joint angles, their values (F, A) and standard deviations (F, A) [degrees]."""
    joints = bones.joints
    return joints.angle_names, np.degrees(joints.angles), np.degrees(joints.angles_sd)


def _check_rate(results: Path, rate: float) -> None:
    if not np.isfinite(rate):
        raise FileProblem(results, "holds a single frame", "Give the results of a recording over time.")


def _task(results: Path) -> str:
    """Return a label from the name of the recording: the folder of results, or the one around it."""
    folder = results.resolve()
    folder = folder.parent if folder.is_file() else folder
    folder = folder.parent if folder.name == "marey" else folder
    return re.sub(r"[^0-9A-Za-z]+", "", folder.name) or "recording"
