"""Orientation of slices on the screen: head or front up, and the patient's left on the right."""

import numpy as np

from marey.arrays import Floats
from marey.knee.outlines.contours import AXES, slice_shape
from marey.knee.space.volume import VoxelGrid

_NAMES = (("right", "left"), ("front", "back"), ("feet", "head"))
"""Names of the directions towards smaller and greater LPS coordinates."""
_DOWN_FIRST = (2, 1, 0)
"""Order of preference of the vertical direction of the screen: along the body, then from front to back."""


def displayed(grid: VoxelGrid, axis: str) -> dict[str, object]:
    """Return how the slices along an axis are shown.

    Returns:
        `rows` and `columns`; `screen_mm`, four numbers a, b, c, d: a pixel (x, y) lies a x + b y to the right and
        c x + d y down the screen, in mm; `sides`, what lies to the left, right, top and bottom.
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
    """Return the sign of a direction to the right or down, and the names of its two ends on the screen."""
    main = int(np.argmax(np.abs(direction)))
    # Down the screen goes towards the feet; all else towards greater LPS: the left and the back.
    wanted = -1 if up and main == 2 else 1
    sign = wanted if direction[main] > 0 else -wanted
    ends = _NAMES[main] if wanted > 0 else _NAMES[main][::-1]
    return sign, ends
