"""Whether two seeds lie in one bone, and whether that one is a femur or a tibia."""

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.knee.bones.marrow import WORK_MM
from marey.knee.space.resampling import read_at
from marey.knee.space.volume import Grid

_DISC_MM = 4.0
_GAP_MM = 3.0
"""Two cortices and the cartilage between them are thicker, the scar of a growth plate is thinner."""
_WIDER = 1.25


def in_line(likeness: np.ndarray, grid: Grid, first: Integers, second: Integers) -> bool:
    """Tell whether marrow goes on from one seed to another, without a gap as wide as a joint.

    Args:
        likeness: (k, j, i) to the marrow, 0 to 1.
        grid: Its own.
        first: (3,) voxel k, j, i.
        second: (3,) voxel k, j, i.
    """
    ends = grid.lps(np.stack([first, second])[:, ::-1].astype(float))
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if length < _GAP_MM:
        return True
    along = ends[0] + np.linspace(0, 1, 1 + int(np.ceil(length / WORK_MM)))[:, None] * (ends[1] - ends[0])
    places = along[:, None] + _disc((ends[1] - ends[0]) / length)
    poor = read_at((likeness > 0).astype(np.float32), grid, places).mean(axis=1) < 0.5
    width = 1 + int(_GAP_MM / WORK_MM)
    return not (np.convolve(poor, np.ones(width, dtype=int)) >= width).any()


def thick_end(mask: Mask) -> str | None:
    """Name a long bone by its thick end: a femur's is below, a tibia's above; None where neither is clearly thicker.

    Args:
        mask: (k, j, i) the bone on the upright grid.
    """
    areas = mask.sum(axis=(1, 2))
    areas = areas[areas > 0]
    third = max(1, len(areas) // 3)
    below, above = float(areas[:third].mean()), float(areas[-third:].mean())
    if below > _WIDER * above:
        return "femur"
    return "tibia" if above > _WIDER * below else None


def _disc(normal: Floats) -> Floats:
    """(n, 3) [mm] places of a disc about the origin."""
    across = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    across /= np.linalg.norm(across)
    steps = np.arange(-_DISC_MM, _DISC_MM + 0.5)
    a, b = np.meshgrid(steps, steps)
    inside = np.hypot(a, b) <= _DISC_MM
    return a[inside][:, None] * across + b[inside][:, None] * np.cross(normal, across)
