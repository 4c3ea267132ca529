"""The accuracy in space that a calibration permits: the covariance of points due to that of the cameras."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.calibration.adjustment.projection import CornerPlaces, project_corners_with_derivative
from marey.calibration.adjustment.state import CAMERA, SHAPE, SessionState
from marey.calibration.quality.world import centres

_GRID = (9, 9, 5)
"""Number of points along x, y and z; chosen by hand."""
_INNER = 0.75
"""Share of the cameras' extent that counts as the capture volume; chosen by hand."""
_HEIGHT = 2.0
"""Height of the capture volume above the floor [m]: that of a person."""
_LEAST_SPREAD = 1e-4
"""Smallest eigenvalue of a point's normal matrix relative to the largest; below it the rays are parallel. By hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VolumeAccuracy:
    """Standard deviations of points in the capture volume, due to the uncertainty of the cameras alone."""

    points: Floats
    """(n, 3) in the world [m]."""
    sd: Floats
    """(n,) root of the trace of the covariance [m]; NaN where fewer than two cameras see the point."""
    cameras: Integers
    """(n,) number of cameras that see the point."""

    def __post_init__(self) -> None:
        freeze_fields(self, "points", "sd")
        freeze_fields(self, "cameras", dtype=np.int64)

    @property
    def rms_mm(self) -> float:
        """Root mean square of the standard deviations [mm]; NaN if no point is seen twice."""
        known = self.sd[np.isfinite(self.sd)]
        return float(1e3 * np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def capture_grid(state: SessionState, *, floor: bool) -> Floats:
    """Return points of the capture volume between the cameras.

    Args:
        state: The cameras.
        floor: Whether the world's z is measured from the floor; otherwise the volume is as high as it is wide.

    Returns:
        (n, 3) [m].
    """
    centre = centres(state)
    low, high = centre.min(axis=0), centre.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * _INNER * np.maximum(high - low, 0.5)
    if floor:
        middle[2], half[2] = 0.5 * _HEIGHT, 0.5 * _HEIGHT
    else:
        ahead = state.camera_rotation[:, 2].mean(axis=0)
        middle = middle + ahead * np.linalg.norm(half) if np.linalg.norm(ahead) > 0.5 else middle
        half[2] = max(half[0], half[1])
    axes = [np.linspace(m - h, m + h, n) for m, h, n in zip(middle, half, _GRID, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def volume_accuracy(
    state: SessionState, covariance: Floats, sizes: tuple[tuple[int, int], ...], points: Floats
) -> VolumeAccuracy:
    """Return how well points are determined by exact pixels in all cameras that see them.

    With the derivatives J of the pixels with respect to a point and K with respect to the cameras, least squares
    turns errors c of the cameras
    into the error -(J^T J)^-1 J^T K c of the point.

    Args:
        state: The cameras.
        covariance: (16 C + 4, 16 C + 4) of the common unknowns.
        sizes: Width and height of the images [px].
        points: (n, 3) in the world [m].
    """
    count, cameras = len(points), state.cameras
    pixel, slope = _all_slopes(state, points)
    inside = np.all((pixel > -0.5) & (pixel < np.array(sizes)[:, None] - 0.5), axis=-1)
    point_slope = np.where(inside[..., None, None], slope[..., CAMERA + SHAPE + 3 :], 0.0)
    normal = np.einsum("cnik,cnil->nkl", point_slope, point_slope)
    values = np.linalg.eigvalsh(normal)
    seen = inside.sum(axis=0)
    good = (seen >= 2) & (values[:, 0] > _LEAST_SPREAD * values[:, 2])
    sd = np.full(count, np.nan)
    for k in np.flatnonzero(good):
        turn = np.zeros((3, CAMERA * cameras))
        for camera in np.flatnonzero(inside[:, k]):
            own = slice(CAMERA * camera, CAMERA * (camera + 1))
            turn[:, own] = np.linalg.solve(normal[k], point_slope[camera, k].T @ slope[camera, k, :, :CAMERA])
        whole = turn @ covariance[: CAMERA * cameras, : CAMERA * cameras] @ turn.T
        sd[k] = np.sqrt(max(float(np.trace(whole)), 0.0))
    return VolumeAccuracy(points=points, sd=sd, cameras=seen)


def _all_slopes(state: SessionState, points: Floats) -> tuple[Floats, Floats]:
    """Return pixels (C, n, 2) and derivatives (C, n, 2, 25) of points of the world in all cameras."""
    still = SessionState(
        lens=state.lens, camera_rotation=state.camera_rotation, camera_translation=state.camera_translation,
        board_rotation=np.eye(3)[None], board_translation=np.zeros((1, 3)), shape=np.zeros(SHAPE),
        delay=np.zeros(state.cameras),
    )  # fmt: skip
    count = len(points)
    found = []
    for camera in range(state.cameras):
        places = CornerPlaces(
            camera=np.full(count, camera), pose=np.zeros(count, np.int64), points=points, centre=np.zeros(3)
        )  # fmt: skip
        found.append(project_corners_with_derivative(still, places))
    return np.stack([each[0] for each in found]), np.stack([each[1] for each in found])
