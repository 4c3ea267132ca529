"""`marey export`: results of a recording in the form in which laboratories and archives exchange them."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import marey
from marey.arrays import Floats
from marey.errors import FileProblem, SettingProblem
from marey.geometry import rotations
from marey.io.results.motion_bids import MISSING, WORLD, MotionChannel, RecordingLabels, write_motion_bids
from marey.motion.motion import BodyMotion
from marey.pipelines.capture.motion import load_motion, motion_file
from marey.pipelines.markers.bones import Bones, load_bones
from marey.view.pages.problems import readable

TARGETS = ("bids",)
"""Forms of exchange: a Motion-BIDS dataset."""
_BONES = "bones.npz"
"""The file of results of `marey markers`."""


def export(
    results: Path | str, *, out: Path | str, to: str = "bids", subject: str = "01", task: str | None = None,
    session: str | None = None, run: int | None = None,
) -> Path:  # fmt: skip
    """Add the results of a recording to a dataset for exchange, as `marey export` does.

    Args:
        results: Results of `marey capture`, `marey shape` or `marey markers`.
        out: Folder of the dataset; it is begun if it does not exist, and recordings are added to it.
        to: `bids`: Motion-BIDS.
        subject: Label of the person: letters and digits.
        task: Label of the task; the name of the recording by default.
        session: Label of the session, if there are several.
        run: Number of the repetition, if there are several.

    Returns:
        The file with the values.

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
    results = Path(results)
    labels = RecordingLabels(subject=subject, task=task or _task(results), session=session, run=run)
    if (results / _BONES).is_file():
        bones = load_bones(results)
        channels, rate = tuple(bone_channels(bones)), bones.rate
    else:
        motion = load_motion(motion_file(results)).data
        channels, rate = tuple(body_channels(motion)), motion.rate
    if not np.isfinite(rate):
        raise FileProblem(results, "holds a single frame", "Give the results of a recording over time.")
    return write_motion_bids(Path(out), labels, channels, rate=rate, version=marey.__version__)


def _task(results: Path) -> str:
    """Return a label from the name of the recording: the folder of results, or the one around it."""
    folder = results.resolve()
    folder = folder.parent if folder.is_file() else folder
    folder = folder.parent if folder.name == "marey" else folder
    return re.sub(r"[^0-9A-Za-z]+", "", folder.name) or "recording"


def body_channels(motion: BodyMotion) -> Iterator[MotionChannel]:
    """Yield the channels of a captured body: time, joints, segments, angles, their standard deviations, and the state.

    Args:
        motion: The motion.
    """
    yield _time(motion.time)
    for j, name in enumerate(motion.joint_names):
        yield from _position(name, motion.joint_centres[:, j], motion.joint_centres_sd[:, j], f"Centre of the {name}")
    for s, name in enumerate(motion.segment_names):
        yield from _orientation(name, motion.segment_rotation[:, s])
    for a, name in enumerate(motion.angle_names):
        yield from _angle(name, motion.angles_deg[:, a], motion.angles_deg_sd[:, a])
    what = "State of the frame: 0 no person detected, 1 measured, 2 filled, 3 lost"
    yield MotionChannel(
        name="state", component=MISSING, kind="MISC", point=MISSING, unit=MISSING,
        values=motion.state.astype(float), description=what,
    )  # fmt: skip


def bone_channels(bones: Bones) -> Iterator[MotionChannel]:
    """Yield the channels of bones from markers: time, origins, orientations, angles, and their standard deviations.

    Args:
        bones: The bones; those of the first method are taken.
    """
    yield _time(bones.time)
    motion = bones.motion
    for s, name in enumerate(motion.segments):
        yield from _position(name, motion.origin[:, s], motion.origin_sd[:, s], f"Origin of the {readable(name)}")
        yield from _orientation(name, motion.rotation[:, s])
    for curve in bones.angles.values():
        yield from _angle(curve.name, curve.values, curve.sd)


def _time(time: Floats) -> MotionChannel:
    return MotionChannel(
        name="latency", component=MISSING, kind="LATENCY", point=MISSING, unit="s", values=time - time[0],
        description="Time since the first frame",
    )  # fmt: skip


def _position(point: str, place: Floats, sd: Floats, what: str) -> Iterator[MotionChannel]:
    for k, axis in enumerate("xyz"):
        yield MotionChannel(
            name=f"{point}_{axis}", component=axis, kind="POS", point=point, unit="m", values=place[:, k],
            description=readable(what), frame=WORLD,
        )  # fmt: skip
    for k, axis in enumerate("xyz"):
        yield MotionChannel(
            name=f"{point}_{axis}_sd", component=axis, kind="MISC", point=point, unit="m", values=sd[:, k],
            description=f"Standard deviation of {point}_{axis}", frame=WORLD,
        )  # fmt: skip


def _orientation(segment: str, rotation: Floats) -> Iterator[MotionChannel]:
    known = np.isfinite(rotation).all((1, 2))
    values = np.full((len(rotation), 4), np.nan)
    if known.any():
        values[known] = rotations.continuous(rotations.to_quaternion(rotation[known]))
    for k, part in enumerate("wxyz"):
        yield MotionChannel(
            name=f"{segment}_quat_{part}", component=f"quat_{part}", kind="ORNT", point=segment, unit=MISSING,
            values=values[:, k], description="Orientation, world from segment, as a unit quaternion", frame=WORLD,
        )  # fmt: skip


def _angle(name: str, values: Floats, sd: Floats | None) -> Iterator[MotionChannel]:
    yield MotionChannel(
        name=name, component=MISSING, kind="JNTANG", point=name, unit="deg", values=values,
        description=f"Angle: {readable(name)}",
    )  # fmt: skip
    if sd is not None:
        yield MotionChannel(
            name=f"{name}_sd", component=MISSING, kind="MISC", point=name, unit="deg", values=sd,
            description=f"Standard deviation of {name}",
        )  # fmt: skip
