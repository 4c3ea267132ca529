"""Whether all cameras look along nearly the same line, from one side of the person or from opposite sides."""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.motion.motion import MEASURED, BodyMotion
from marey.pipelines.verdict import VerdictReason
from marey.wording import listed

LEAST_ANGLE_DEG = 45.0
"""Angle between the lines of sight of two cameras to the person from which on they determine its depth [deg]. With
pairs of cameras of four rendered takes (50 frames each), joints are 7 to 17 mm off at 77 to 88 degrees, and 12 to 50 mm
in three of them at 26 to 36 degrees, where the cameras stand opposite each other; angles between were not measured."""


def one_direction_reasons(motion: BodyMotion, cameras: Sequence[Camera]) -> Iterator[VerdictReason]:
    """Name cameras that all see the person along nearly the same line.

    Args:
        motion: The motion.
        cameras: The cameras that recorded it.

    Yields:
        One reason if no two cameras see the person from clearly different directions.
    """
    measured = motion.joint_centres[motion.state == MEASURED].reshape(-1, 3)
    measured = measured[np.isfinite(measured).all(axis=1)]
    if not len(measured):
        return
    widest = _widest_angle_deg(np.median(measured, axis=0), cameras)
    if widest < LEAST_ANGLE_DEG:
        names = tuple(camera.name for camera in cameras)
        yield VerdictReason.limit(
            f"{listed(names)} see the person along nearly the same line, from one side or from opposite sides: their "
            f"lines of sight differ by {widest:.0f} degrees. Places along this line can be wrong by much more than the "
            "stated standard deviations.",
            "Place a camera to the side, so that two of them see the person at about 90 degrees.",
            cause="one direction", cameras=names,
        )  # fmt: skip


def _widest_angle_deg(place: Floats, cameras: Sequence[Camera]) -> float:
    """Return the largest angle between the lines, without direction, from two cameras to a place (3,) [deg]."""
    lines = [(place - camera.centre) / np.linalg.norm(place - camera.centre) for camera in cameras]
    cosines = [min(1.0, abs(float(first @ second))) for first, second in combinations(lines, 2)]
    return float(np.degrees(np.arccos(min(cosines))))
