"""Channels of a Motion-BIDS recording from the results of a capture or a marker trial."""

from collections.abc import Iterator

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.io.results.motion_bids import MISSING, WORLD, MotionChannel
from marey.motion.motion import BodyMotion
from marey.pipelines.markers.bones import Bones
from marey.view.pages.problems import readable


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
