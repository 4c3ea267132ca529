"""What each picture of each camera contributes: errors, tilt and distance of the board, and coverage of the images."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.calibration.adjustment.solve import SolvedSession
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.quality.world import centre_slope, centred_covariance

COVERAGE = (6, 8)
"""Rows and columns of the cells in which the coverage of an image is counted; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewQuality:
    """Figures of each view, which is one picture of one camera."""

    camera: Integers
    """(V,)."""
    picture: Integers
    """(V,)."""
    corners: Integers
    """(V,) number of corners."""
    error_px: Floats
    """(V,) root mean square distance of the corners from the predictions of the common adjustment [px]."""
    scatter: Floats
    """(V,) root mean square distance without a displacement of the board, over its expectation."""
    corner_sd_px: Floats
    """(V,) median standard deviation of a corner as measured in the picture [px]."""
    tilt_deg: Floats
    """(V,) angle between the board's normal and the direction to the camera [deg]."""
    distance_m: Floats
    """(V,) of the board's centre [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "camera", "picture", "corners", dtype=np.int64)
        freeze_fields(self, "error_px", "scatter", "corner_sd_px", "tilt_deg", "distance_m")


def view_quality(solved: SolvedSession) -> ViewQuality:
    """Return the figures of all views that were used."""
    corners, adjusted, state = solved.corners, solved.adjusted, solved.state
    starts, count = corners.view_starts, corners.view_counts
    square = np.square(np.nan_to_num(adjusted.residual)).sum(axis=1)
    own = np.square(adjusted.distance) * adjusted.view_factor[corners.view] ** 2
    sd = adjusted.unit * np.sqrt(0.5 * np.trace(corners.covariance, axis1=1, axis2=2))
    pose = adjusted.problem.pose[corners.view_picture]
    middle = state.board_translation[pose] + state.board_rotation[pose] @ adjusted.problem.board.centre
    camera = corners.view_camera
    seen = (state.camera_rotation[camera] @ middle[..., None])[..., 0] + state.camera_translation[camera]
    normal = (state.camera_rotation[camera] @ state.board_rotation[pose][:, :, 2:])[..., 0]
    distance = np.linalg.norm(seen, axis=1)
    cosine = np.abs(np.sum(normal * seen, axis=1)) / distance
    # A wand and a point have no normal.
    cosine = np.where(adjusted.problem.landmark_pose[pose] | (not isinstance(adjusted.problem.board, CalibrationBoard)),
                      np.nan, cosine)
    return ViewQuality(
        camera=camera, picture=corners.view_picture, corners=count,
        error_px=np.sqrt(np.add.reduceat(square, starts) / count),
        scatter=np.sqrt(np.add.reduceat(own, starts) / (2 * count)),
        corner_sd_px=np.array([np.median(each) for each in np.split(sd, starts[1:])]),
        tilt_deg=np.degrees(np.arccos(np.clip(cosine, 0, 1))), distance_m=distance,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraQuality:
    """Figures of one camera."""

    name: str
    pictures: int
    """Number of pictures with the board."""
    corners: int
    rms_px: float
    """Root mean square distance of its corners from their predictions [px]; NaN without corners."""
    median_px: float
    """Median distance [px]."""
    coverage: Integers
    """(6, 8) number of corners in each cell of its image."""
    tilt_deg: tuple[float, float]
    """Range of the boards' tilts, from the 5th to the 95th percentile [deg]."""
    distance_m: tuple[float, float]
    """Range of the boards' distances, from the 5th to the 95th percentile [m]."""
    lens: Floats
    """(9,) in the order of `LENS_NAMES`."""
    lens_sd: Floats
    """(9,) standard deviations; zero for a parameter that was not estimated."""
    rotation_sd_deg: float
    """Standard deviation of its rotation about any axis, in the world [deg]."""
    position_sd_mm: float
    """Root of the trace of the covariance of its centre, in the world [mm]."""
    relative_rotation_sd_deg: float
    """The same relative to the other cameras: about the rigid motion that fits all best [deg]."""
    relative_position_sd_mm: float
    """The same relative to the other cameras [mm]."""

    @property
    def covered(self) -> float:
        """Share of the cells of its image in which corners were found."""
        return float(np.mean(self.coverage > 0))


def camera_quality(solved: SolvedSession, views: ViewQuality) -> tuple[CameraQuality, ...]:
    """Return the figures of all cameras.

    Args:
        solved: The solved session.
        views: The figures of its views.
    """
    relative = centred_covariance(solved.covariance, solved.state)
    return tuple(_of_camera(solved, views, relative, camera) for camera in range(solved.state.cameras))


def _of_camera(solved: SolvedSession, views: ViewQuality, relative: Floats, camera: int) -> CameraQuality:
    corners = solved.corners
    own, seen = corners.camera == camera, views.camera == camera
    distance = np.linalg.norm(solved.adjusted.residual[own], axis=1)
    lens = slice(CAMERA * camera, CAMERA * camera + LENS)
    turn, place = _pose_sd(solved, solved.covariance, camera)
    relative_turn, relative_place = _pose_sd(solved, relative, camera)
    return CameraQuality(
        name=corners.cameras[camera], pictures=int(seen.sum()), corners=int(own.sum()),
        rms_px=float(np.sqrt(np.mean(distance**2))) if own.any() else np.nan,
        median_px=float(np.median(distance)) if own.any() else np.nan,
        coverage=coverage_counts(corners.pixels[own], corners.sizes[camera]),
        tilt_deg=_range(views.tilt_deg[seen]), distance_m=_range(views.distance_m[seen]),
        lens=solved.state.lens[camera], lens_sd=np.sqrt(np.diag(solved.covariance)[lens]),
        rotation_sd_deg=turn, position_sd_mm=place,
        relative_rotation_sd_deg=relative_turn, relative_position_sd_mm=relative_place,
    )  # fmt: skip


def _pose_sd(solved: SolvedSession, covariance: Floats, camera: int) -> tuple[float, float]:
    start = CAMERA * camera + LENS
    own = covariance[start : start + 6, start : start + 6]
    slope = centre_slope(solved.state, camera)
    turn, place = np.trace(own[:3, :3]), np.trace(slope @ own @ slope.T)
    return float(np.degrees(np.sqrt(max(turn, 0.0)))), float(1e3 * np.sqrt(max(place, 0.0)))


def _range(values: Floats) -> tuple[float, float]:
    values = values[np.isfinite(values)]
    if not len(values):
        return np.nan, np.nan
    low, high = np.percentile(values, [5, 95])
    return float(low), float(high)


def coverage_counts(pixels: Floats, size: tuple[int, int]) -> Integers:
    """Count corners by cells of the image.

    Args:
        pixels: (n, 2) [px].
        size: Width and height of the image [px].

    Returns:
        (6, 8).
    """
    rows, columns = COVERAGE
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=(rows, columns), range=((-0.5, size[1] - 0.5), (-0.5, size[0] - 0.5))
    )
    return counts.astype(np.int64)
