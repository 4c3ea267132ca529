"""Recognition of fisheye lenses by the fits of both lens models to the views of one camera alone."""

from collections.abc import Iterator

import cv2
import numpy as np

from marey.arrays import Floats
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.finding import Examined, Finding

_WIDE = 0.62
"""Focal length in widths of the image below which a lens may be a fisheye: a field of view of 78 degrees; by hand."""
_LEAST_CORNERS = 12
"""Least number of corners of a view that is compared; chosen by hand."""
_MOST_VIEWS = 24
"""Largest number of views that are compared; chosen by hand."""
_LEAST_VIEWS = 8
"""Least number of views; chosen by hand."""
_BETTER = 0.8
"""Ratio of the residuals of the fisheye model to those of the other up to which a lens is a fisheye; by hand."""


def fisheye_lenses(session: Examined) -> Iterator[Finding]:
    """Name cameras whose corners fit OpenCV's fisheye model much better than the radial and tangential one."""
    board = session.solved.adjusted.problem.board
    if not isinstance(board, CalibrationBoard):
        return
    for camera, name in enumerate(session.corners.cameras):
        focal = session.solved.state.lens[camera, 0] / max(session.corners.sizes[camera])
        if focal > _WIDE or not session.cameras[camera].pictures:
            continue
        found = _residuals(session.corners, board, camera)
        if found is not None and found[1] < _BETTER * found[0]:
            yield Finding(
                code="fisheye-lens", severity="problem",
                text=f"{name} has a fisheye lens: its views alone fit such a model to {found[1]:.2f} px, the radial "
                f"and tangential model of this calibration to {found[0]:.2f} px only.",
                advice="Set a narrower (linear) field of view, or calibrate it as a fisheye with another program; "
                    "marey capture reads such cameras.",
            )  # fmt: skip


def _residuals(corners: CornerSet, board: CalibrationBoard, camera: int) -> tuple[float, float] | None:
    """Return the RMS residuals of the radial and of the fisheye model, with poses of their own [px], or None."""
    views = np.flatnonzero((corners.view_camera == camera) & (corners.view_counts >= _LEAST_CORNERS))
    if len(views) < _LEAST_VIEWS:
        return None
    # Views far from the middle of the image distinguish the models best.
    size = corners.sizes[camera]
    reach = [np.linalg.norm(corners.pixels[corners.view_rows(k)] - 0.5 * np.array(size), axis=1).max() for k in views]
    chosen = views[np.sort(np.argsort(reach)[-_MOST_VIEWS:])]
    points = [(board.points[corners.corner[corners.view_rows(k)]] * [1, 1, 0])[:, None] for k in chosen]
    pixels = [corners.pixels[corners.view_rows(k)][:, None] for k in chosen]
    try:
        return _radial_residual(points, pixels, size), _fisheye_residual(points, pixels, size)
    except cv2.error:
        return None


def _radial_residual(points: list[Floats], pixels: list[Floats], size: tuple[int, int]) -> float:
    plain = [each.astype(np.float32) for each in points], [each.astype(np.float32) for each in pixels]
    return float(cv2.calibrateCamera(*plain, size, np.zeros((3, 3)), np.zeros(5))[0])


def _fisheye_residual(points: list[Floats], pixels: list[Floats], size: tuple[int, int]) -> float:
    focal = max(size) / np.pi
    matrix = np.array([[focal, 0, 0.5 * size[0]], [0, focal, 0.5 * size[1]], [0, 0, 1]])
    # OpenCV 5 moved these out of the module of the fisheye.
    names = ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW", "CALIB_USE_INTRINSIC_GUESS")
    flags = sum(int(getattr(cv2.fisheye, name, None) or getattr(cv2, name)) for name in names)
    return float(cv2.fisheye.calibrate(points, pixels, size, matrix, np.zeros(4), flags=flags)[0])
