"""Side of a knee, and mirroring of one side to the other."""

from collections.abc import Mapping

import numpy as np

from marey.arrays import frozen
from marey.knee.space.surface import TriangleSurface

MIRROR = frozen(np.diag([-1.0, 1.0, 1.0, 1.0]))
"""Homogeneous, at the scanner's sagittal plane through its origin."""
_LEAST_OFF_MM = 2.0
"""Least distance [mm] of the patella's middle from the femur's, across the knee, to name a side; chosen by hand."""


def mirrored(surface: TriangleSurface) -> TriangleSurface:
    """Mirror a surface left to right, as `MIRROR` does; its faces are oriented outward again.

    The vertices keep their order.
    """
    return TriangleSurface(vertices_mm=surface.vertices_mm @ MIRROR[:3, :3], faces=surface.faces[:, ::-1])


def is_left(bones: Mapping[str, TriangleSurface]) -> bool | None:
    """Return whether a knee is a left one: the patella lies to the lateral side of the femur's middle.

    Args:
        bones: By name.

    Returns:
        None where there is no patella or no femur, or it lies in the middle.
    """
    if "patella" not in bones or "femur" not in bones:
        return None
    patella, femur = (bones[name].vertices_mm[:, 0] for name in ("patella", "femur"))
    off = 0.5 * (patella.min() + patella.max() - femur.min() - femur.max())
    return None if abs(off) < _LEAST_OFF_MM else bool(off > 0)
