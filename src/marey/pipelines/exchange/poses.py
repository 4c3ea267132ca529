"""Positions and angles of results as a poses dataset of `movement`."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.results.movement import PoseTracks
from marey.motion.motion import BodyMotion
from marey.pipelines.markers.bones import Bones


def poses_of_people(motions: Mapping[str, BodyMotion], *, results: Path) -> PoseTracks:
    """Return joint centres and angles of captured people, who share the frames of one recording.

    Args:
        motions: The motion of each person, by name.
        results: The folder of the results, for error messages.

    Raises:
        FileProblem: The motions differ in their frames or joints.
    """
    first, *others = motions.values()
    for (before, _), (name, motion) in pairwise(motions.items()):
        alike = motion.joint_names == first.joint_names and motion.angle_names == first.angle_names
        if not alike or not np.array_equal(motion.time, first.time):
            raise FileProblem(
                results, f"holds motions of {before} and {name} that differ in their frames or joints",
                "Export the folder of each person.",
            )  # fmt: skip
    each = [first, *others]
    return PoseTracks(
        people=tuple(motions), names=first.joint_names, time=first.time, rate=first.rate,
        positions=_stacked([motion.joint_centres for motion in each]),
        position_sds=_stacked([motion.joint_centres_sd for motion in each]), angle_names=first.angle_names,
        angles=_stacked([motion.angles_deg for motion in each]),
        angle_sds=_stacked([motion.angles_deg_sd for motion in each]),
        states=np.stack([motion.state for motion in each], -1),
    )  # fmt: skip


def poses_of_bones(bones: Bones, *, person: str) -> PoseTracks:
    """Return the origins and joint angles of bones from markers.

    Args:
        bones: The bones; those of the first method are taken.
        person: Name of the person.
    """
    joints = bones.joints
    return PoseTracks(
        people=(person,), names=bones.segments, time=bones.time, rate=bones.rate,
        positions=bones.motion.origin[..., None], position_sds=bones.motion.origin_sd[..., None],
        angle_names=joints.angle_names, angles=np.degrees(joints.angles)[..., None],
        angle_sds=np.degrees(joints.angles_sd)[..., None],
    )  # fmt: skip


def _stacked(arrays: Sequence[Floats]) -> Floats:
    """Stack arrays along a new last axis, one entry per person."""
    return np.stack(arrays, -1)
