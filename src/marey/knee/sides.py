"""A right knee as a left one, and the other way about."""

import numpy as np

from marey.arrays import frozen
from marey.knee.surface import Surface

MIRROR = frozen(np.diag([-1.0, 1.0, 1.0, 1.0]))
"""Homogeneous, at the scanner's sagittal plane through its origin."""


def mirrored(surface: Surface) -> Surface:
    """Mirror a surface left to right, as `MIRROR` does; its faces turn outward again.

    The vertices stay in their order.
    """
    return Surface(vertices_mm=surface.vertices_mm @ MIRROR[:3, :3], faces=surface.faces[:, ::-1])
