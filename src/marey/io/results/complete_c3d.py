"""Writing all that is known of a motion into one C3D: points, rotations, joint angles, events, standard deviations."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.markers.c3d import c3d_of_points, open_c3d, save_c3d
from marey.io.markers.c3d_angles import AnglePoint, add_angles
from marey.io.opensim.trc import PointPaths
from marey.io.units import MM_PER_M
from marey.motion.events.cycles import GaitEvent
from marey.motion.motion import BodyMotion

_RESIDUAL_STEP_MM, _LARGEST_STEP = 0.25, 255
"""Unit of the residuals [mm], and their largest multiple that the byte of the format holds: 63.75 mm."""


def write_body_c3d(
    path: Path | str, motion: BodyMotion, *, angles: Sequence[AnglePoint], events: Sequence[GaitEvent] = ()
) -> None:
    """Write a captured motion as one C3D, in millimetres and the world's axes (Z up).

    The residual of a point is the standard deviation of its position: the root mean square over the three axes, in
    steps of 0.25 mm up to 63.75 mm.

    Args:
        path: The file.
        motion: The motion.
        angles: The joint angles.
        events: Gait events on the clock of the motion.
    """
    paths = PointPaths(names=motion.joint_names, time=motion.time, rate=motion.rate, points=motion.joint_centres)
    begun = [replace(event, time=event.time - float(motion.time[0])) for event in events]
    c3d = c3d_of_points(
        paths, segment_names=motion.segment_names, segment_rotation=motion.segment_rotation,
        segment_origin=motion.segment_origin, events=begun,
    )  # fmt: skip
    c3d["parameters"]["POINT"]["SCALE"]["value"] = [-_RESIDUAL_STEP_MM]
    residuals = c3d["data"]["meta_points"]["residuals"]
    c3d["data"]["meta_points"]["residuals"] = np.where(residuals < 0, residuals, _residuals(motion.joint_centres_sd))
    add_angles(c3d, angles)
    with replacing(path) as temporary:
        save_c3d(c3d, temporary)


def _residuals(spread: Floats) -> Floats:
    """Return residuals (1, J, F) [mm] from standard deviations (F, J, 3) [m]; 0, of unknown accuracy, for NaN."""
    rms = MM_PER_M * np.sqrt(np.square(spread).mean(-1))
    return np.asarray(np.clip(np.nan_to_num(rms), 0.0, _RESIDUAL_STEP_MM * _LARGEST_STEP).T[None])


def write_c3d_with_angles(path: Path | str, source: Path, angles: Sequence[AnglePoint]) -> None:
    """Copy a C3D with joint angles added.

    Args:
        path: The new file.
        source: The C3D, with points, rotations and events.
        angles: The joint angles, one row per frame of the source.

    Raises:
        FileProblem: The source is damaged, or has another number of frames.
    """
    c3d = open_c3d(source)
    count = c3d["data"]["points"].shape[2]
    if angles and len(angles[0].values) != count:
        raise FileProblem(
            source, f"has {count} frames, and the angles beside it have {len(angles[0].values)}",
            "Run the command that wrote it again.",
        )  # fmt: skip
    add_angles(c3d, angles)
    with replacing(path) as temporary:
        save_c3d(c3d, temporary)
