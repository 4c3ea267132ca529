"""Orientation of the slices of a volume on the screen: head or front up, the patient's left on the right."""

import numpy as np

from marey.arrays import Floats
from marey.knee.outlines.contours import AXES, slice_shape
from marey.knee.space.volume import VoxelGrid

_NAMES = (("right", "left"), ("front", "back"), ("feet", "head"))
"""Names of the directions of decreasing and increasing LPS coordinates."""
_DOWN_FIRST = (2, 1, 0)
"""LPS axes in the order of preference for the vertical of the screen: along the body, then front to back."""


def displayed(grid: VoxelGrid, axis: str) -> dict[str, object]:
    """Return how the slices across an axis are displayed.

    Args:
        grid: Grid of the volume.
        axis: Name of the axis across which the slices are taken.

    Returns:
        `rows` and `columns`; `screen_mm`, four numbers a, b, c, d: pixel (x, y) is displayed at a x + b y to the right
        and c x + d y down the screen [mm]; `sides`, the names of the directions left, right, up and down.
    """
    along = AXES.index(axis)
    column, row = (each for each in range(3) if each != along)
    directions = grid.lps_from_voxel[:3, :3]
    column_mm, row_mm = directions[:, column], directions[:, row]
    main = [int(np.argmax(np.abs(each))) for each in (column_mm, row_mm)]
    turned = _DOWN_FIRST.index(main[0]) < _DOWN_FIRST.index(main[1])
    across, down = (row_mm, column_mm) if turned else (column_mm, row_mm)
    rightward = _shown(across, up=False)
    downward = _shown(down, up=True)
    sizes = float(np.linalg.norm(across)) * rightward[0], float(np.linalg.norm(down)) * downward[0]
    matrix = [0.0, sizes[0], sizes[1], 0.0] if turned else [sizes[0], 0.0, 0.0, sizes[1]]
    rows, columns = slice_shape(grid, axis)
    return {"rows": rows, "columns": columns, "screen_mm": matrix, "sides": [*rightward[1], *downward[1]]}


def _shown(direction: Floats, *, up: bool) -> tuple[int, tuple[str, str]]:
    """Return the sign with which a direction is displayed to the right or down, and the names of its two ends."""
    main = int(np.argmax(np.abs(direction)))
    # Downward is towards the feet; the other directions are towards increasing LPS, left and back.
    wanted = -1 if up and main == 2 else 1
    sign = wanted if direction[main] > 0 else -wanted
    ends = _NAMES[main] if wanted > 0 else _NAMES[main][::-1]
    return sign, ends
