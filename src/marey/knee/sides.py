"""A right knee as a left one, and the other way about."""

import numpy as np

from marey.knee.surface import Surface


def mirrored(surface: Surface) -> Surface:
    """Mirror a surface left to right, at the scanner's sagittal plane; its faces turn outward again.

    The vertices stay in their order.
    """
    return Surface(vertices_mm=surface.vertices_mm * np.array([-1.0, 1.0, 1.0]), faces=surface.faces[:, ::-1])
