"""Functions shared by the readers of calibrations: checked cameras from raw values, with all faults collected."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera, camera_faults
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform


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
            self.clauses.append(f"camera '{camera}' {joined}")

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
        size, matrix = finite(self.size, (2,)), numbers(self.matrix, (3, 3))
        distortion, rotation = numbers(self.distortion, None), rotation_matrix(self.rotation)
        translation = finite(self.translation, (3,))
        if size is None or matrix is None or distortion is None or rotation is None or translation is None:
            needed = {
                "a size of 2 numbers (width and height in pixels)": size,
                "a matrix of 3 x 3 numbers": matrix,
                "a list of numbers as distortions": distortion,
                "a rotation of 3 numbers (axis times angle, in radians) or 3 x 3": rotation,
                "a translation of 3 numbers": translation,
            }
            faults.add(self.name, [f"needs {what}" for what, value in needed.items() if value is None])
            return None
        both = (int(size[0]), int(size[1]))
        clauses = camera_faults(both, matrix, distortion, fisheye=self.fisheye)
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


def numbers(value: object, shape: tuple[int, ...] | None) -> Floats | None:
    """Convert lists of a file to an array, or return None if they are not numbers of the given shape.

    Args:
        value: The value in the file.
        shape: The required shape; None for a vector of any length.

    Returns:
        The array, or None.
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return None
    fits = array.ndim == 1 if shape is None else array.shape == shape
    return array if fits else None


def finite(value: object, shape: tuple[int, ...] | None) -> Floats | None:
    """Convert lists to an array as `numbers` does, but also return None if a number is not finite."""
    array = numbers(value, shape)
    return array if array is not None and np.isfinite(array).all() else None


def rotation_matrix(value: object) -> Floats | None:
    """Convert a rotation vector or matrix to an exact rotation matrix (3, 3), or return None if it is neither."""
    vector = finite(value, (3,))
    if vector is not None:
        return rotations.exp(vector)
    matrix = finite(value, (3, 3))
    if matrix is None:
        return None
    u, _, v = np.linalg.svd(matrix)
    # Files contain rounded numbers; a matrix with an entry off by more than 0.001 is not a rotation.
    if np.abs(u @ v - matrix).max() > 1e-3 or np.linalg.det(u @ v) < 0:
        return None
    return np.asarray(u @ v)


def make_rig(faults: Faults, cameras: Iterable[Camera | None]) -> Rig:
    """Return a rig of the cameras, or raise an error with all faults."""
    made = [camera for camera in cameras if camera is not None]
    names = [camera.name for camera in made]
    faults.clauses += [f"has several cameras named '{name}'" for name in sorted(set(names)) if names.count(name) > 1]
    faults.raise_if_any()
    return Rig(tuple(made))
