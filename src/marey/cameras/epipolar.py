"""Epipolar lines between two cameras, with lens distortion."""

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.geometry.vectors import unit

_PARALLEL = 1e-12
"""Squared sine of the angle between two rays below which they count as parallel; near the limit of float64."""


def epipolar_lines(first: Camera, second: Camera, pixels: Floats, starts: Floats) -> tuple[Floats, Floats]:
    """Return the tangent of the epipolar line of each pixel near a start in the second image.

    With lens distortion the line is a curve. Its tangent deviates from it by at most 0.014 px over ten pixels and
    0.0001 px over one, for a lens with k1 = -0.3 and an image of 640 px.

    Args:
        first: The camera of the template image.
        second: The camera of the searched image.
        pixels: (n, 2) in the first image [px].
        starts: (n, 2) near the line in the second image [px].

    Returns:
        Points (n, 2) on the lines near the starts [px], and unit directions (n, 2), in which the depth in the first
        image grows. NaN where the rays through both pixels are parallel or meet behind a camera.
    """
    ray, other = first.rays(pixels).directions, second.rays(starts).directions
    baseline = second.centre - first.centre
    cosine = np.sum(ray * other, axis=-1)
    square = 1 - cosine**2
    meeting = np.where(square > _PARALLEL, square, np.nan)
    depth = (ray @ baseline - cosine * (other @ baseline)) / meeting
    depth = np.where(depth > 0, depth, np.nan)
    points, pixel_wrt_point = second.project_with_derivative(first.centre + depth[:, None] * ray)
    directions = np.einsum("nij,nj->ni", pixel_wrt_point, ray)
    return points, unit(directions)
