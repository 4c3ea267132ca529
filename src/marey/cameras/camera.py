"""A calibrated camera with its lens: projection of points to pixels, and rays of pixels."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from marey.arrays import Floats, freeze_fields, frozen
from marey.cameras import lens
from marey.cameras.rays import PluckerLines
from marey.errors import SettingProblem
from marey.geometry.rigid import RigidTransform

RADIAL_COUNTS = (0, 4, 5, 8, 12)
"""Numbers of distortion coefficients that OpenCV's radial and tangential model allows."""
FISHEYE_COUNTS = (0, 4)
"""Numbers of distortion coefficients that OpenCV's fisheye model allows."""

_BLIND_SHARE = 0.05
"""Largest allowed share of the image in which the lens model is not invertible.

A calibration may fail in the outermost corners, which no board covered. Chosen by hand.
"""
_GREATEST_BEND = 1.4
"""Largest allowed ratio of distorted to undistorted radius.

Strong pincushion lenses reach about 1.1; coefficients in the wrong order give larger ratios. Chosen by hand.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A calibrated camera.

    Raises:
        SettingProblem: A number is missing or impossible; the message lists everything that is wrong.

    Example:
        >>> import marey
        >>> camera = marey.read_cameras(marey.example_folder())["cam01"]
        >>> pixel = camera.project([[0.0, 0.0, 1.0]])
        >>> pixel.shape
        (1, 2)
    """

    name: str
    """Name of the camera in files and messages."""
    size: tuple[int, int]
    """Width and height of the image [px]."""
    matrix: Floats
    """(3, 3) focal lengths, skew and principal point [px]."""
    distortion: Floats
    """k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]] as in OpenCV; k1 k2 k3 k4 for a fisheye; empty without distortion."""
    fisheye: bool = False
    """True for OpenCV's fisheye model."""
    camera_from_world: RigidTransform
    """Transform from world to camera axes: x right, y down, z forward."""

    def __repr__(self) -> str:
        return f"Camera {self.name} ({self.width} x {self.height} px)"

    def __post_init__(self) -> None:
        freeze_fields(self, "matrix")
        object.__setattr__(self, "distortion", frozen(self.distortion).ravel())
        object.__setattr__(self, "size", (int(self.size[0]), int(self.size[1])))
        faults = camera_faults(self.size, self.matrix, self.distortion, fisheye=self.fisheye)
        if faults:
            raise SettingProblem(f"Camera '{self.name}' {' and '.join(faults)}.")

    @cached_property
    def packed(self) -> Floats:
        """The camera as one vector for kernels, in the layout of `marey.cameras.lens`."""
        pose = self.camera_from_world
        return frozen(_pack(self.matrix, self.distortion, fisheye=self.fisheye, pose=pose))

    @cached_property
    def centre(self) -> Floats:
        """The centre of projection (3,) in the world [m]."""
        return frozen(self.camera_from_world.inverse().translation)

    @property
    def width(self) -> int:
        """Width of the image [px]."""
        return self.size[0]

    @property
    def height(self) -> int:
        """Height of the image [px]."""
        return self.size[1]

    def project(self, points: Floats) -> Floats:
        """Project points of the world.

        Args:
            points: (..., 3) [m].

        Returns:
            (..., 2) [px]; NaN for points behind the camera and beyond the range in which the lens is one to one.
        """
        points = np.ascontiguousarray(points, float)
        out = np.empty((points.size // 3, 3))
        lens.project_points(self.packed, points.reshape(-1, 3), out)
        return out[:, :2].reshape(*points.shape[:-1], 2).copy()

    def project_with_derivative(self, points: Floats) -> tuple[Floats, Floats]:
        """Project points of the world, with the derivatives of the pixels with respect to the points.

        Args:
            points: (n, 3) [m].

        Returns:
            Pixels (n, 2) [px] and pixel_wrt_point (n, 2, 3) [px/m]; NaN as in `project`.
        """
        points = np.ascontiguousarray(points, float)
        pixels, derivative = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
        lens.project_points_with_derivative(self.packed, points, pixels, derivative)
        return pixels, derivative

    def depths(self, points: Floats) -> Floats:
        """Return the depths of points.

        Args:
            points: (..., 3) [m].

        Returns:
            (...) [m] along the optical axis, negative behind the camera.
        """
        return np.asarray(
            np.asarray(points, float) @ self.camera_from_world.rotation[2] + self.camera_from_world.translation[2]
        )

    def undistort(self, pixels: Floats) -> Floats:
        """Undistort pixels.

        Args:
            pixels: (..., 2) [px].

        Returns:
            (..., 2) x/z and y/z in camera axes; NaN where the lens model is not invertible.
        """
        pixels = np.ascontiguousarray(pixels, float)
        out = np.empty((pixels.size // 2, 2))
        lens.undistort_pixels(self.packed, pixels.reshape(-1, 2), out)
        return out.reshape(pixels.shape)

    def rays(self, pixels: Floats) -> PluckerLines:
        """Return the rays of pixels.

        Args:
            pixels: (..., 2) [px].

        Returns:
            Lines in the world, directed away from the camera; NaN where the lens model is not invertible.
        """
        straight = self.undistort(pixels)
        directions = np.concatenate([straight, np.ones_like(straight[..., :1])], axis=-1)
        return PluckerLines.through(self.centre, directions @ self.camera_from_world.rotation)

    def contour_planes(self, pixels: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Return the planes through the camera's centre that are tangent to contours, exact for every lens.

        The signed distance of a world point x from its plane is `plane_normals @ x - offsets` [m]; it is positive
        on the side to which the normal of the contour points.

        Args:
            pixels: (n, 2) points of contours [px].
            normals: (n, 2) normals of the contours in the image, of any length.

        Returns:
            Unit normals (n, 3) and offsets (n,) [m]; NaN where the lens model is not invertible.
        """
        out = np.empty((len(pixels), 3))
        pixels, normals = np.ascontiguousarray(pixels, float), np.ascontiguousarray(normals, float)
        lens.contour_normals(self.packed, pixels, normals, out)
        return out, out @ self.centre

    def ray_turns(self, pixels: Floats, steps: Floats) -> Floats:
        """Return the angles by which the ray turns over steps in the image.

        Args:
            pixels: (n, 2) centres of the steps [px].
            steps: (n, 2) [px].

        Returns:
            (n,) [rad], for steps of a few pixels; NaN where the lens model is not invertible.
        """
        out = np.empty(len(pixels))
        pixels, steps = np.ascontiguousarray(pixels, float), np.ascontiguousarray(steps, float)
        lens.ray_turns(self.packed, pixels, steps, out)
        return out

    def sees(self, pixels: Floats, *, margin: float = 0.0) -> np.ndarray:
        """Return which pixels lie inside the image.

        Args:
            pixels: (..., 2) [px].
            margin: Smallest allowed distance from the border [px].

        Returns:
            (...) bool; false for NaN.
        """
        x, y = np.moveaxis(np.asarray(pixels, float), -1, 0)
        low = margin - 0.5
        return np.asarray((x >= low) & (y >= low) & (x <= self.width - 1 - low) & (y <= self.height - 1 - low))

    def scaled(self, factor: float) -> "Camera":
        """Return the camera of images that are resized by a factor.

        Pixel centres keep integer coordinates: x' = (x + 0.5) factor - 0.5, which is what
        `cv2.resize(image, None, fx=factor, fy=factor)` does.

        Args:
            factor: Ratio of new to old size.

        Returns:
            The camera; its size is rounded as OpenCV rounds it.
        """
        shift = 0.5 * factor - 0.5
        resize = np.array([[factor, 0, shift], [0, factor, shift], [0, 0, 1]])
        size = (max(1, round(self.width * factor)), max(1, round(self.height * factor)))
        return replace(self, size=size, matrix=resize @ self.matrix)

    def moved(self, new_from_old: RigidTransform) -> "Camera":
        """Return the same camera in another world frame.

        Args:
            new_from_old: Transform from the present world frame to the new one.

        Returns:
            The camera in the new world.
        """
        return replace(self, camera_from_world=self.camera_from_world @ new_from_old.inverse())


def camera_faults(size: tuple[int, int], matrix: Floats, distortion: Floats, *, fisheye: bool) -> list[str]:
    """List the errors in the intrinsic parameters of a camera.

    Args:
        size: Width and height [px].
        matrix: (3, 3) [px].
        distortion: (n,) distortion coefficients.
        fisheye: Whether the lens is OpenCV's fisheye.

    Returns:
        One clause per error, each to follow "Camera 'NAME' ..."; empty if there is none.
    """
    faults = []
    if min(size) < 1:
        faults.append(f"has the size {size[0]} x {size[1]}; width and height in pixels must be positive")
    faults += matrix_faults(np.asarray(matrix, float)) + _count_faults(np.asarray(distortion, float), fisheye=fisheye)
    if faults:
        return faults
    focal = tuple(np.asarray(matrix, float)[:2].ravel().tolist())
    return list(_range_faults(size, focal, tuple(np.asarray(distortion, float).tolist()), fisheye=fisheye))


def matrix_faults(matrix: Floats) -> list[str]:
    """List the errors in a camera matrix, each as the middle of a sentence ("has ...")."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return ["has a matrix that is not 3 x 3 finite numbers"]
    if min(matrix[0, 0], matrix[1, 1]) <= 0:
        return [f"has the focal lengths {matrix[0, 0]:g} and {matrix[1, 1]:g}; they must be positive"]
    if abs(matrix[1, 0]) > 1e-9 or np.abs(matrix[2] - [0, 0, 1]).max() > 1e-9:
        return ["has a matrix that is not [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"]
    return []


def _count_faults(distortion: Floats, *, fisheye: bool) -> list[str]:
    if fisheye and distortion.size not in FISHEYE_COUNTS:
        return [f"has {distortion.size} distortion coefficients; a fisheye lens has 4: k1 k2 k3 k4"]
    if not fisheye and distortion.size not in RADIAL_COUNTS:
        known = "4 (k1 k2 p1 p2), 5 (with k3), 8 (with k4 k5 k6) or 12 (with s1 s2 s3 s4)"
        return [f"has {distortion.size} distortion coefficients; a lens has {known}"]
    if not np.isfinite(distortion).all():
        return [f"has a distortion coefficient that is not finite: {np.array2string(distortion, precision=4)}"]
    return []


@lru_cache(maxsize=256)
def _range_faults(
    size: tuple[int, int], rows: tuple[float, ...], coefficients: tuple[float, ...], *, fisheye: bool
) -> tuple[str, ...]:
    """Check that the lens model is invertible and plausible in the whole image; cameras that are moved keep their lens.

    Args:
        size: Width and height [px].
        rows: (6,) the first two rows of the camera matrix [px].
        coefficients: (n,) distortion coefficients.
        fisheye: Whether the lens is OpenCV's fisheye.

    Returns:
        At most one clause, as of `camera_faults`.
    """
    matrix, distortion = np.array([*rows, 0.0, 0.0, 1.0]).reshape(3, 3), np.array(coefficients)
    packed = _pack(matrix, distortion, fisheye=fisheye, pose=RigidTransform.identity())
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, 41), np.linspace(0, size[1] - 1, 41))
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    straight = np.empty_like(pixels)
    lens.undistort_pixels(packed, pixels, straight)
    blind = np.isnan(straight[:, 0])
    numbers = np.array2string(distortion, precision=4, separator=", ")
    if blind.mean() > _BLIND_SHARE:
        share = f"{100 * blind.mean():.0f} % of its image"
        return (f"has the distortion coefficients {numbers}, which are not invertible in {share}",)
    bent = (pixels - matrix[:2, 2]) @ np.linalg.inv(matrix[:2, :2]).T
    bend = np.linalg.norm(bent, axis=1) / np.maximum(np.linalg.norm(straight, axis=1), 1e-9)
    far = np.linalg.norm(bent, axis=1) > 0.1
    if np.any(far) and np.nanmax(np.where(far, bend, 0)) > _GREATEST_BEND:
        stretched = f"they stretch the image {np.nanmax(bend):.1f} times"
        return (f"has implausible distortion coefficients {numbers}: {stretched}",)
    return ()


def _pack(matrix: Floats, distortion: Floats, *, fisheye: bool, pose: RigidTransform) -> Floats:
    packed = np.zeros(lens.PACKED)
    packed[:9], packed[9:12] = pose.rotation.ravel(), pose.translation
    packed[lens.FX : lens.MODEL] = matrix[0, 0], matrix[0, 1], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    packed[lens.MODEL] = float(fisheye)
    packed[lens.LENS : lens.LENS + len(distortion)] = distortion
    packed[lens.LIMIT] = _invertible_radius(fisheye, tuple(distortion.tolist())) ** 2
    return packed


@lru_cache(maxsize=256)
def _invertible_radius(fisheye: bool, distortion: tuple[float, ...]) -> float:
    """Find the radius of (x/z, y/z) up to which a lens is invertible; cameras that are moved keep their lens."""
    packed = np.zeros(lens.PACKED)
    packed[lens.MODEL] = float(fisheye)
    packed[lens.LENS : lens.LENS + len(distortion)] = distortion
    return float(lens.one_to_one_radius(packed))
