"""A person's mass from the volume of the body, for recordings without a known mass."""

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.surface import Body

BODY_DENSITY, BODY_DENSITY_SD = 1032.0, 20.0
"""Density of a whole person and its standard deviation among people [kg/m3]: the mean that
`segment_measures.segment_measures` gives for the generic body with the densities of [Dempster1955], as tabled in
[Winter2009]; the deviation is the 2 % of `segment_measures.DENSITY_SD`."""
CLOTHES_SD_M = 0.008
"""Standard deviation of the thickness of clothes [m], over the whole surface: they are part of every silhouette. Shirts
of the takes `jacks` and `office` are 12 and 20 mm off the skin of the trunk alone. Chosen by hand."""


def estimated_mass(body: Body) -> tuple[float, float]:
    """Estimate a person's mass from the volume of the closed skin.

    Args:
        body: The body.

    Returns:
        The mass and its standard deviation [kg], from the body's shape, the density of people, and clothes.
    """
    corners = body.vertices[body.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    volume = float(np.einsum("ta,ta->", corners.mean(1), normals) / 3)
    area = float(np.linalg.norm(normals, axis=1).sum())
    spread = np.array([_shape_sd(body, normals), CLOTHES_SD_M * area, volume * BODY_DENSITY_SD / BODY_DENSITY])
    return BODY_DENSITY * volume, BODY_DENSITY * float(np.linalg.norm(spread))


def _shape_sd(body: Body, normals: Floats) -> float:
    """Return the standard deviation of the volume [m3] by the covariance of the shape; that of people if unknown."""
    covariance = body.space.prior_covariance if body.numbers_covariance is None else body.numbers_covariance
    if not len(body.numbers):
        return 0.0
    # A surface that moves by d changes its volume by the sum of its faces' normals times their mean d.
    slope = np.einsum("ntca,ta->n", body.space.vertex_modes[:, body.faces], normals) / 3
    return float(np.sqrt(slope @ covariance @ slope))
