"""Recognition of fisheye lenses by the fits of both lens models to the views of one camera alone."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import scipy.optimize
import scipy.sparse

from marey.arrays import Floats
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.finding import Examined, Finding
from marey.geometry import rotations

_WIDE = 0.62
"""Focal length in widths of the image below which a lens may be a fisheye: a field of view of 78 degrees; by hand."""
_LEAST_CORNERS = 12
"""Least number of corners of a view that is compared; chosen by hand."""
_MOST_VIEWS = 24
"""Largest number of views that are compared; chosen by hand."""
_LEAST_VIEWS = 8
"""Least number of views; chosen by hand."""
_LENS = 6
"""Number of parameters of a lens: focal length, centre, and three radial coefficients."""
_MOST_STEPS = 60
"""Largest number of steps of a fit; chosen by hand."""
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
    middle = 0.5 * np.array(size)
    reach = [np.linalg.norm(corners.pixels[corners.view_rows(int(k))] - middle, axis=1).max() for k in views]
    chosen = views[np.sort(np.argsort(reach)[-_MOST_VIEWS:])]
    points = [board.points[corners.corner[corners.view_rows(int(k))]] * [1, 1, 0] for k in chosen]
    pixels = [corners.pixels[corners.view_rows(int(k))] for k in chosen]
    try:
        _, matrix, _, turns, shifts = cv2.calibrateCamera(
            [each.astype(np.float32) for each in points], [each.astype(np.float32) for each in pixels], size,
            np.zeros((3, 3)), np.zeros(5), flags=cv2.CALIB_ZERO_TANGENT_DIST,
        )  # fmt: skip
    except cv2.error:
        return None
    poses = np.concatenate([np.concatenate([np.ravel(a), np.ravel(b)]) for a, b in zip(turns, shifts, strict=True)])
    start = np.concatenate([[matrix[0, 0], matrix[0, 2], matrix[1, 2], 0.0, 0.0, 0.0], poses])
    return _fitted(points, pixels, start, fisheye=False), _fitted(points, pixels, start, fisheye=True)


def _fitted(points: Sequence[Floats], pixels: Sequence[Floats], start: Floats, *, fisheye: bool) -> float:
    """Fit a lens with three radial coefficients and the pose of each view; return the robust residual [px]."""
    view = np.repeat(np.arange(len(points)), [len(each) for each in points])
    places, measured = np.concatenate(points), np.concatenate(pixels)
    # Each view depends on the lens and its own pose only.
    pattern = scipy.sparse.lil_matrix((2 * len(view), len(start)), dtype=int)
    pattern[:, :_LENS] = 1
    for column in range(6):
        for axis in range(2):
            pattern[2 * np.arange(len(view)) + axis, _LENS + 6 * view + column] = 1

    def residual(vector: Floats) -> Floats:
        pose = vector[_LENS:].reshape(-1, 6)
        turned = (rotations.exp(pose[:, :3])[view] @ places[..., None])[..., 0] + pose[view, 3:]
        x, y = (turned[:, :2] / np.maximum(turned[:, 2:], 1e-3)).T
        focal, across, down, k1, k2, k3 = vector[:_LENS]
        radius = np.maximum(np.hypot(x, y), 1e-9)
        angle = np.arctan(radius) if fisheye else radius
        t = angle * angle
        scale = angle / radius * (1.0 + t * (k1 + t * (k2 + t * k3)))
        found = np.stack([focal * scale * x + across, focal * scale * y + down], axis=-1)
        return np.asarray((found - measured).ravel())

    found = scipy.optimize.least_squares(
        residual, start, x_scale="jac", jac_sparsity=pattern, loss="soft_l1", f_scale=1.0, max_nfev=_MOST_STEPS
    )
    return float(np.sqrt(np.mean(np.minimum(found.fun**2, 25.0))))
