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
    place = np.median(measured, axis=0)
    widest = _widest_angle_deg(place, cameras)
    if widest < LEAST_ANGLE_DEG:
        names = tuple(camera.name for camera in cameras)
        yield VerdictReason.limit(
            f"{_along(place, cameras)} Places along these lines of sight can be wrong by much more than the "
            "stated standard deviations.",
            "Place a camera to the side, so that two of them see the person at about 90 degrees.",
            cause="one direction", cameras=names,
        )  # fmt: skip


def _along(place: Floats, cameras: Sequence[Camera]) -> str:
    """Describe how cameras that all look along nearly the same line stand around a place (3,)."""
    names, directions = [camera.name for camera in cameras], _directions(place, cameras)
    if len(cameras) == 2:
        apart = np.degrees(np.arccos(np.clip(directions[0] @ directions[1], -1, 1)))
        how = "nearly face each other" if apart > 90 else "see the person from nearly the same direction"
        return f"{' and '.join(names)} {how}: seen from the person, they are {apart:.0f} degrees apart."
    widest = _widest_angle_deg(place, cameras)
    return (
        f"{listed(names)} see the person along nearly the same line, from one side or from opposite sides: their lines "
        f"of sight differ by {widest:.0f} degrees at most."
    )


def _directions(place: Floats, cameras: Sequence[Camera]) -> list[Floats]:
    """Return the unit vectors (3,) from the cameras to a place (3,)."""
    return [(place - camera.centre) / np.linalg.norm(place - camera.centre) for camera in cameras]


def _widest_angle_deg(place: Floats, cameras: Sequence[Camera]) -> float:
    """Return the largest angle between the lines, without direction, from two cameras to a place (3,) [deg]."""
    directions = _directions(place, cameras)
    cosines = [min(1.0, abs(float(first @ second))) for first, second in combinations(directions, 2)]
    return float(np.degrees(np.arccos(min(cosines))))
