"""Functions shared by the readers of calibrations: checked cameras from raw values, with all faults collected."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera, camera_faults
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.documents import finite, numbers
from marey.io.file_names import name_faults, shown_name

_LARGEST_IMAGE = 65536
"""Largest width and height of an image [px]. Chosen by hand: larger ones are mistakes."""
_FOCAL_RANGE = (0.05, 200.0)
"""Range of plausible focal lengths relative to the larger side of the image: a view of 170 to 0.3 degrees. By hand."""
_FARTHEST_POINT = 3.0
"""Largest distance of the principal point from the middle of the image, in its larger sides. Chosen by hand: a part
of a larger image may be used, whose centre is outside."""
_LARGEST_ANGLE = 4 * np.pi
"""Largest angle of a rotation vector [rad]; larger ones are degrees. Chosen by hand: other programs reach 2 pi."""
_SAME_POSE = 1e-9
"""Largest difference of poses that are the same pose [m, and entries of the rotation]: rounding only."""


class Faults:
    """Collects the faults of a file, so that they are reported in one error.

    Args:
        path: The file.
        remedy: Description of a correct file, as a sentence.
    """

    def __init__(self, path: Path, remedy: str):
        self.path, self.remedy = path, remedy
        self.clauses: list[str] = []

    def add(self, camera: str, clauses: Iterable[str]) -> None:
        """Add the faults of a camera; each clause continues "camera 'NAME' ..."."""
        joined = ", and ".join(clauses)
        if joined:
            self.clauses.append(f"camera '{shown_name(camera)}' {joined}")

    def raise_if_any(self) -> None:
        """Raise one FileProblem with all faults, if there are any."""
        if self.clauses:
            raise FileProblem(self.path, "; ".join(self.clauses), self.remedy)


@dataclass(frozen=True, eq=False, kw_only=True)
class RawCamera:
    """A camera with the unchecked lists and numbers of a file."""

    name: str
    size: object
    """Width and height [px]."""
    matrix: object
    """3 x 3 intrinsic matrix [px]."""
    distortion: object
    """Distortion coefficients in the order of OpenCV."""
    rotation: object
    """Rotation from world to camera: axis times angle [rad], or a matrix."""
    translation: object
    """Translation from world to camera [m]."""
    fisheye: bool = False

    def checked(self, faults: Faults) -> Camera | None:
        """Return the checked camera, or add its faults and return None."""
        unusable = name_faults(self.name)
        if unusable:
            faults.add(self.name, unusable)
            return None
        size, matrix = finite(self.size, (2,)), numbers(self.matrix, (3, 3))
        distortion, rotation = numbers(self.distortion, None), rotation_matrix(self.rotation)
        translation = finite(self.translation, (3,))
        if size is None or matrix is None or distortion is None or rotation is None or translation is None:
            needed = {
                "a size of 2 numbers (width and height in pixels)": size,
                "a matrix of 3 x 3 numbers": matrix,
                "a list of numbers as distortions": distortion,
                "a rotation of 3 numbers (axis times angle, in radians) or 3 x 3 (not a reflection)": rotation,
                "a translation of 3 numbers": translation,
            }
            faults.add(self.name, [f"needs {what}" for what, value in needed.items() if value is None])
            return None
        clauses = _size_faults(size) or _focal_faults(size, matrix)
        both = (int(size[0]), int(size[1]))
        clauses = clauses or camera_faults(both, matrix, distortion, fisheye=self.fisheye)
        faults.add(self.name, clauses)
        if clauses:
            return None
        return Camera(
            name=self.name,
            size=both,
            matrix=matrix,
            distortion=distortion,
            fisheye=self.fisheye,
            camera_from_world=RigidTransform(rotation, translation),
        )


def _size_faults(size: Floats) -> list[str]:
    if max(size) > _LARGEST_IMAGE or any(float(side) != int(side) for side in size):
        return [f"has the size {size[0]:g} x {size[1]:g}; it must be a width and height in whole pixels"]
    return []


def _focal_faults(size: Floats, matrix: Floats) -> list[str]:
    focal, side = np.abs([matrix[0, 0], matrix[1, 1]]), max(float(max(size)), 1.0)
    low, high = _FOCAL_RANGE
    if np.isfinite(focal).all() and focal.min() > 0 and not (low * side < focal.min() and focal.max() < high * side):
        wrong = f"has the focal lengths {focal[0]:g} and {focal[1]:g} for an image of {size[0]:g} x {size[1]:g}"
        return [f"{wrong}; they must be in pixels"]
    point = matrix[:2, 2]
    if np.isfinite(point).all() and np.abs(point - size / 2).max() > _FARTHEST_POINT * side:
        wrong = f"has the principal point {point[0]:g}, {point[1]:g} in an image of {size[0]:g} x {size[1]:g}"
        return [f"{wrong}; it must be in pixels from the top left corner"]
    return []


def rotation_matrix(value: object) -> Floats | None:
    """Convert a rotation vector or matrix to an exact rotation matrix (3, 3), or return None if it is neither."""
    vector = finite(value, (3,))
    if vector is not None:
        return rotations.exp(vector) if np.abs(vector).max() <= _LARGEST_ANGLE else None
    matrix = finite(value, (3, 3))
    if matrix is None or np.abs(matrix).max() > 2:
        return None
    u, _, v = np.linalg.svd(matrix)
    # Files contain rounded numbers; a matrix with an entry off by more than 0.001 is not a rotation.
    if np.abs(u @ v - matrix).max() > 1e-3 or np.linalg.det(u @ v) < 0:
        return None
    return np.asarray(u @ v)


def quaternion_matrix(quaternion: Floats) -> Floats | None:
    """Convert a quaternion (4,), real part first, to a rotation matrix; None if its length is not 1 within 1 %."""
    length = float(np.linalg.norm(quaternion))
    if quaternion.shape != (4,) or not np.isfinite(length) or abs(length - 1) > 0.01:
        return None
    w, *v = np.asarray(quaternion, float) / length
    axis = np.asarray(v)
    return np.asarray((w * w - axis @ axis) * np.eye(3) + 2 * np.outer(axis, axis) + 2 * w * rotations.hat(axis))


def make_rig(faults: Faults, cameras: Iterable[Camera | None]) -> Rig:
    """Return a rig of the cameras, or raise an error with all faults."""
    made = [camera for camera in cameras if camera is not None]
    names = [camera.name for camera in made]
    faults.clauses += [f"has several cameras named '{name}'" for name in sorted(set(names)) if names.count(name) > 1]
    faults.clauses += _same_poses(made)
    faults.raise_if_any()
    if not made:
        raise FileProblem(faults.path, "has no camera", faults.remedy)
    return Rig(tuple(made))


def _same_poses(cameras: Sequence[Camera]) -> list[str]:
    """List the first pair of cameras that have one pose: a file with lenses only, or a camera that is there twice."""
    poses = [(camera.name, camera.camera_from_world) for camera in cameras]
    for number, (name, pose) in enumerate(poses):
        for other, next_pose in poses[number + 1 :]:
            apart = np.abs(pose.translation - next_pose.translation).max()
            if max(apart, np.abs(pose.rotation - next_pose.rotation).max()) < _SAME_POSE:
                return [f"has the cameras '{name}' and '{other}' at the same place, so their poses are not known"]
    return []
