"""A first world of cameras in any axes and unit, from the space that a person's silhouettes have in common.

The person is upright in most pictures: the longest direction of the visual hulls points up, and their height is that
of a person. This is accurate to some degrees and 10 %, which is sufficient to capture the person.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.fit.search.hull import HullGrid, filled, largest_part, room_between
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

COARSE_CELLS = 20
"""Cells from the middle of the room to the largest distance of a person from it. Chosen by hand."""
FINE_CELLS = 36
"""Cells along the longest side of the box around a person: 5 cm. Chosen by hand."""
LEAST_HULLS = 5
"""Least number of frames in which the silhouettes have a common part. Chosen by hand."""
LEAST_ELONGATION = 1.5
"""Least ratio of the standard deviations of the hulls along and across their longest direction, below which nobody
stands. `reach`, `walk`, `jacks` and `stealth` have HULL_RATIOS."""
HEIGHT_SHARES = (0.5, 99.5)
"""Percentiles of the cells between which the height is measured: single cells may lie outside of the person. Chosen by
hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HullWorld:
    """A first world with Z up along the person and the origin below the person."""

    world_from_given: RigidTransform
    """Rotation and translation, in the unit of the given cameras."""
    height: float
    """Height of the person in that unit."""


def hull_world(cameras: Sequence[Camera], pictures: Sequence[Sequence[Mask]]) -> HullWorld | None:
    """Find up and the height of a person from silhouettes.

    Args:
        cameras: C cameras in any axes and unit; most of them are upright, which decides where the head is.
        pictures: For each frame C silhouettes (height, width); those without the person are empty.

    Returns:
        The first world; None if the silhouettes have no common part in too many frames, or nobody stands.
    """
    hulls = [cells for masks in pictures if len(cells := _hull(cameras, masks))]
    if len(hulls) < LEAST_HULLS:
        return None
    spread = np.mean([np.cov(cells.T) for cells in hulls], axis=0)
    values, vectors = np.linalg.eigh(spread)
    if values[2] < LEAST_ELONGATION**2 * values[1]:
        return None
    above = -np.sum([camera.camera_from_world.rotation[1] for camera in cameras], axis=0)
    up = vectors[:, 2] * np.sign(vectors[:, 2] @ above)
    heights = np.array([np.percentile(cells @ up, HEIGHT_SHARES) for cells in hulls])
    middle = np.median([cells.mean(axis=0) for cells in hulls], axis=0)
    turn = rotations.shortest(up, np.array([0.0, 0.0, 1.0]))
    origin = turn @ middle
    origin[2] = np.median(heights[:, 0])
    return HullWorld(world_from_given=RigidTransform(turn, -origin), height=float(np.median(np.ptp(heights, axis=1))))


def _hull(cameras: Sequence[Camera], masks: Sequence[Mask]) -> Floats:
    """Return the cells (n, 3) of the largest object that all cameras show; empty if there is none."""
    seeing = [(camera, mask) for camera, mask in zip(cameras, masks, strict=True) if mask.any()]
    witnesses = min(3, len(cameras))
    if len(seeing) < witnesses:
        return np.zeros((0, 3))
    centre, reach = room_between([camera for camera, _ in seeing])
    rough = HullGrid.about(centre, reach, reach / COARSE_CELLS)
    somewhere = rough.centres(largest_part(filled(seeing, rough, witnesses=witnesses)))
    if len(somewhere) == 0:
        return somewhere
    size = float(np.ptp(somewhere, axis=0).max())
    # Legs and arms are thinner than the large cells.
    grid = HullGrid.holding(somewhere, 0.5 * size, size / FINE_CELLS)
    return grid.centres(largest_part(filled(seeing, grid, witnesses=witnesses)))
