"""Which of two views that contradict each other is out of step: that which interrupts the motion in its own camera."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.solve import LeftOut
from marey.calibration.boards.corners import BoardSighting, CornerSet

_LEAST_COMMON = 4
"""Least number of corners that pictures must share to be compared; chosen by hand."""
_INTERRUPTED = 0.3
"""Distance of the corners from the continued motion, in shifts per picture, beyond which it is interrupted.

It is 1 for a picture that shows the next instant, and half the relative change of the speed otherwise. By hand."""
_CLEARLY = 3.0
"""Ratio of these distances from which one of two views is at fault, and not the other; chosen by hand."""
_LEAST_SHIFT_PX = 1.0
"""Shift per picture below which no interruption can be seen [px]; chosen by hand."""


def without_cleared_views(corners: CornerSet, views: Sequence[LeftOut]) -> list[LeftOut]:
    """Return views without those that continue the motion in their camera while the other one interrupts it.

    Of two views that contradict each other, both are left out, though mostly one of them is wrong.

    Args:
        corners: All corners, also those that were left out.
        views: Views that were left out, each of one camera.
    """
    seen = {(picture, camera): found for picture, camera, found in corners.sightings()}
    apart = {
        (each.picture, each.camera): interruption(seen, each.picture, each.camera)
        for each in views if each.camera is not None
    }  # fmt: skip
    cleared = set()
    for (picture, camera), own in apart.items():
        others = [value for (at, other), value in apart.items() if at == picture and other != camera]
        if others and max(others) > max(_INTERRUPTED, _CLEARLY * own):
            cleared.add((picture, camera))
    return [each for each in views if (each.picture, each.camera) not in cleared]


def interruption(seen: dict[tuple[int, int], BoardSighting], picture: int, camera: int) -> float:
    """Return how far the corners of a view are from the motion in the pictures around it.

    Args:
        seen: The corners by picture and camera.
        picture: The picture.
        camera: The camera.

    Returns:
        Median distance of the corners, relative to their shift per picture; NaN where the pictures around are unknown.
    """
    # From both neighbours, or continued from the two pictures before or after.
    ways = (((-1, 0.5), (1, 0.5), 0.5), ((-2, -1.0), (-1, 2.0), 1.0), ((1, 2.0), (2, -1.0), 1.0))
    found = [_distance(seen, picture, camera, way) for way in ways]
    known = [each for each in found if np.isfinite(each)]
    return known[0] if known else np.nan


def _distance(
    seen: dict[tuple[int, int], BoardSighting], picture: int, camera: int,
    way: tuple[tuple[int, float], tuple[int, float], float],
) -> float:  # fmt: skip
    (first, first_share), (second, second_share), per_picture = way
    near = [seen.get((picture + step, camera)) for step in (0, first, second)]
    if any(each is None for each in near):
        return np.nan
    own, a, b = (each for each in near if each is not None)
    common = np.intersect1d(np.intersect1d(own.corner, a.corner), b.corner).astype(np.int64)
    if len(common) < _LEAST_COMMON:
        return np.nan
    here, before, after = (_pixels(each, common) for each in (own, a, b))
    shift = per_picture * np.median(np.linalg.norm(after - before, axis=1))
    if shift < _LEAST_SHIFT_PX:
        return np.nan
    return float(np.median(np.linalg.norm(here - first_share * before - second_share * after, axis=1)) / shift)


def _pixels(sighting: BoardSighting, corner: Integers) -> Floats:
    return np.asarray(sighting.pixels[np.searchsorted(sighting.corner, corner)])
