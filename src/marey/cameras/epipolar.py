"""Epipolar lines: where a second camera can see what a first one sees in a pixel."""

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera

_PARALLEL = 1e-12
"""Squared sine of the angle between two rays below which they do not meet."""


def epipolar_lines(first: Camera, second: Camera, pixels: Floats, starts: Floats) -> tuple[Floats, Floats]:
    """Give the piece of each pixel's epipolar line that lies near a start in the second picture.

    Through a lens the line is a curve; this is its tangent, which leaves it by 0.014 px in ten pixels and by 0.0001 px
    in one, at most, where a lens with k1 = -0.3 fills 640 pixels.

    Args:
        first: The camera of the template picture.
        second: The camera of the search picture.
        pixels: (n, 2) in the first picture [px].
        starts: (n, 2) near the line in the second picture [px].

    Returns:
        Points (n, 2) on the lines near the starts [px], and unit directions (n, 2), in which the depth in the first
        picture grows. NaN where the rays through both pixels are parallel or meet behind a camera.
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
    return points, directions / np.linalg.norm(directions, axis=-1, keepdims=True)
