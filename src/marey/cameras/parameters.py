"""The parameters of a camera as numbers: steps of them, and the derivatives of pixels with respect to them."""

from dataclasses import replace

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

PARAMETER_NAMES = (
    "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "rx", "ry", "rz", "tx", "ty", "tz",
)  # fmt: skip
"""Parameters of a camera: of its lens [px, 1], then left rotation [rad] and translation [m] from world to camera; those
of calibration.json."""
PARAMETERS = len(PARAMETER_NAMES)
"""Number of parameters of a camera."""
LENS_PARAMETERS = 9
"""Number of parameters of a lens, the first of a camera."""
_TURN, _SHIFT = slice(9, 12), slice(12, 15)
"""Places of rotation and translation among the parameters."""


def project_with_slopes(camera: Camera, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Project points of the world, with the derivatives with respect to the points and to the camera's parameters.

    The derivatives with respect to the distortion are those of the model with five coefficients.

    Args:
        camera: The camera.
        points: (n, 3) [m].

    Returns:
        Pixels (n, 2) [px], and their derivatives with respect to the points (n, 2, 3) [px/m] and to the parameters
        (n, 2, 15); NaN for points that the camera cannot see.
    """
    pixels, by_point = camera.project_with_derivative(points)
    pose = camera.camera_from_world
    turned = points @ pose.rotation.T
    in_camera = by_point @ pose.rotation.T
    slopes = np.empty((len(points), 2, PARAMETERS))
    slopes[:, :, :9] = _lens_slopes(camera, pixels, turned + pose.translation)
    slopes[:, :, _TURN] = -in_camera @ rotations.hat(turned)
    slopes[:, :, _SHIFT] = in_camera
    return pixels, by_point, slopes


def _lens_slopes(camera: Camera, pixels: Floats, seen: Floats) -> Floats:
    """Return the derivatives (n, 2, 9) of pixels with respect to the lens, for points in camera axes (n, 3)."""
    (fx, _, cx), (_, fy, cy) = camera.matrix[0], camera.matrix[1]
    x, y = (seen[:, :2] / np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)).T
    s = x * x + y * y
    slopes = np.zeros((len(pixels), 2, 9))
    slopes[:, 0, 0], slopes[:, 1, 1] = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    slopes[:, 0, 2] = slopes[:, 1, 3] = 1.0
    for row, along, focal in ((0, x, fx), (1, y, fy)):
        slopes[:, row, 4], slopes[:, row, 5], slopes[:, row, 8] = (focal * along * s**k for k in (1, 2, 3))
        slopes[:, row, 6 + row] = 2 * focal * x * y
        slopes[:, row, 7 - row] = focal * (s + 2 * along * along)
    return slopes


def stepped_camera(camera: Camera, step: Floats) -> Camera:
    """Return a camera whose parameters were changed.

    Args:
        camera: The camera.
        step: (15,) changes in the order of `PARAMETER_NAMES`.
    """
    pose, matrix = camera.camera_from_world, np.array(camera.matrix)
    matrix[0, 0], matrix[1, 1] = matrix[0, 0] + step[0], matrix[1, 1] + step[1]
    matrix[:2, 2] += step[2:4]
    moved = RigidTransform(rotations.exp(step[_TURN]) @ pose.rotation, pose.translation + step[_SHIFT])
    bend = np.zeros(max(len(camera.distortion), 5 if step[8] else 4 if step[4:8].any() else 0))
    bend[: len(camera.distortion)] = camera.distortion
    more = np.concatenate([step[4:8], step[8:9]])[: len(bend)]
    bend[: len(more)] += more
    return replace(camera, matrix=matrix, distortion=bend, camera_from_world=moved)


def pose_basis(camera: Camera) -> Floats:
    """Return the changes (15, 6) of the parameters for a rotation about the camera's centre and a shift of the centre.

    Args:
        camera: The camera.

    Returns:
        Columns for a left rotation in camera axes [rad], and for a shift of the centre in world axes [m].
    """
    pose, basis = camera.camera_from_world, np.zeros((PARAMETERS, 6))
    basis[_TURN, :3] = np.eye(3)
    # The translation is -R c: with the rotation, its change is w x t.
    basis[_SHIFT, :3] = -rotations.hat(pose.translation)
    basis[_SHIFT, 3:] = -pose.rotation
    return basis


def focal_basis(camera: Camera) -> Floats:
    """Return the change (15, 1) of the parameters for a relative change of both focal lengths."""
    basis = np.zeros((PARAMETERS, 1))
    basis[:2, 0] = camera.matrix[0, 0], camera.matrix[1, 1]
    return basis
