"""How tall a body stands at rest, and how well that is known."""

import numpy as np

from marey.body.surface import Body


def stature(body: Body) -> tuple[float, float]:
    """Measure a body from its lowest to its highest point at rest.

    Args:
        body: Of which the height is wanted.

    Returns:
        The height [m], and its standard deviation [m]: NaN where the body's numbers have no covariance.
    """
    highest, lowest = int(np.argmax(body.vertices[:, 2])), int(np.argmin(body.vertices[:, 2]))
    height = float(body.vertices[highest, 2] - body.vertices[lowest, 2])
    if body.numbers_covariance is None:
        return height, float("nan")
    by_number = body.space.vertex_modes[:, highest, 2] - body.space.vertex_modes[:, lowest, 2]
    return height, float(np.sqrt(by_number @ body.numbers_covariance @ by_number))
