"""Epipolar lines and planes of two cameras, with lens distortion."""

import math
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.lens import project_points_with_derivative, undistort_pixel
from marey.compiled.kernels import kernel
from marey.geometry.vectors import unit

_PARALLEL = 1e-12
"""Squared sine of the angle between two rays below which they count as parallel; near the limit of float64."""
_LEAST_BASELINE = 1e-6
"""Distance of two centres below which they are one [m]. Chosen by hand."""


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
    pixels, starts = (np.ascontiguousarray(given, float) for given in (pixels, starts))
    points, directions = np.empty((len(pixels), 2)), np.empty((len(pixels), 2))
    _lines(first.packed, second.packed, first.centre, second.centre, pixels, starts, points, directions)
    return points, directions


@kernel(error_model="numpy")
def _lines(first, second, centre, second_centre, pixels, starts, points, directions):
    """Write points and directions of lines; the tests compare them with the plain formula."""
    count = len(pixels)
    rays, meeting = np.empty((count, 3)), np.empty((count, 3))
    derivative = np.empty((count, 2, 3))
    for i in range(count):
        ray, other = _direction(first, pixels[i]), _direction(second, starts[i])
        cosine, along, along_other = 0.0, 0.0, 0.0
        for k in range(3):
            cosine += ray[k] * other[k]
            along += ray[k] * (second_centre[k] - centre[k])
            along_other += other[k] * (second_centre[k] - centre[k])
        square = 1 - cosine**2
        depth = (along - cosine * along_other) / square if square > _PARALLEL else np.nan
        for k in range(3):
            rays[i, k] = ray[k]
            meeting[i, k] = centre[k] + depth * ray[k] if depth > 0 else np.nan
    project_points_with_derivative(second, meeting, points, derivative)
    for i in range(count):
        x, y = 0.0, 0.0
        for k in range(3):
            x += derivative[i, 0, k] * rays[i, k]
            y += derivative[i, 1, k] * rays[i, k]
        length = math.sqrt(x * x + y * y)
        directions[i, 0], directions[i, 1] = x / length, y / length


@kernel
def _direction(packed, pixel):
    """Return the unit direction of a pixel's ray in the world."""
    x, y = undistort_pixel(packed, pixel[0], pixel[1])
    length = math.sqrt(x * x + y * y + 1.0)
    x, y, z = x / length, y / length, 1.0 / length
    return (
        packed[0] * x + packed[3] * y + packed[6] * z,
        packed[1] * x + packed[4] * y + packed[7] * z,
        packed[2] * x + packed[5] * y + packed[8] * z,
    )


@dataclass(frozen=True, eq=False)
class EpipolarPlanes:
    """The planes through the centres of two cameras, numbered by their angle about the baseline.

    A point that both cameras see at one instant lies in the same plane for both of them, whatever their lenses.
    """

    axis: Floats
    """(3,) unit vector from the first centre to the second."""
    zero: Floats
    """(3,) unit vector across the axis, in the plane of angle 0."""

    @staticmethod
    def between(first: Camera, second: Camera) -> "EpipolarPlanes | None":
        """Return the planes of two cameras; None if both have the same centre."""
        baseline = second.centre - first.centre
        if not np.linalg.norm(baseline) > _LEAST_BASELINE:
            return None
        axis = unit(baseline)
        upright = np.eye(3)[np.argmin(np.abs(axis))]
        return EpipolarPlanes(axis, unit(upright - axis * (axis @ upright)))

    def angles(self, directions: Floats) -> tuple[Floats, Floats]:
        """Return the planes of rays of either camera.

        Args:
            directions: (n, 3) unit directions.

        Returns:
            The angles (n,) of the planes from -pi to pi [rad], and the sines (n,) of the angles between the rays and
            the baseline: the plane of a ray turns by one over this number times the angle by which the ray turns
            across it.
        """
        along, across = directions @ self.zero, directions @ np.cross(self.axis, self.zero)
        return np.arctan2(across, along), np.hypot(along, across)
