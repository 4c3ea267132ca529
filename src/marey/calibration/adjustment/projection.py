"""Projection of board corners, with the derivatives with respect to all unknowns."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.state import CAMERA, LENS, SHAPE, SessionState, shaped_points
from marey.geometry.rotations import hat

BOARD_COLUMNS = slice(CAMERA + SHAPE, CAMERA + SHAPE + 6)
"""Columns of the board pose in the derivatives: rotation [rad], then translation [m]."""
COLUMNS = CAMERA + SHAPE + 6
"""Columns of the derivatives: a camera (15), the board's shape (4), a board pose (6)."""
LATE_COLUMN = COLUMNS
"""Column behind them in the rows of the adjustment: the delay of the camera [pictures]."""
RESIDUAL_COLUMN = COLUMNS + 1
"""Last column of the rows of the adjustment: the residual."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CornerPlaces:
    """Which camera, board pose and corner belongs to each observation."""

    camera: Integers
    """(N,) camera."""
    pose: Integers
    """(N,) board pose."""
    points: Floats
    """(N, 3) the corner on the ideal board [m]."""
    centre: Floats
    """(3,) centre of the board [m]."""


def project_corners(state: SessionState, places: CornerPlaces) -> tuple[Floats, Floats]:
    """Project corners.

    Args:
        state: Values of the unknowns.
        places: The corners.

    Returns:
        Pixels (N, 2) [px], NaN behind a camera, and positions in camera axes (N, 3) [m].
    """
    shaped, _ = shaped_points(places.points, state.shape, places.centre)
    world = _turned(state.board_rotation[places.pose], shaped) + state.board_translation[places.pose]
    seen = _turned(state.camera_rotation[places.camera], world) + state.camera_translation[places.camera]
    depth = np.where(seen[:, 2] > 0, seen[:, 2], np.nan)
    lens = state.lens[places.camera].T
    u, v = _distorted(lens, seen[:, 0] / depth, seen[:, 1] / depth)
    return np.stack([lens[0] * u + lens[2], lens[1] * v + lens[3]], axis=-1), seen


def project_corners_with_derivative(state: SessionState, places: CornerPlaces) -> tuple[Floats, Floats]:
    """Project corners, with the derivatives with respect to camera, board shape and board pose.

    With left increments of rotations, X_c = exp(w) R_c X_w + t_c and X_w = exp(v) R_b X_b + t_b, the derivatives of X_c
    are -[R_c X_w]x, I, -R_c [R_b X_b]x and R_c.

    Args:
        state: Values of the unknowns.
        places: The corners.

    Returns:
        Pixels (N, 2) [px], NaN behind a camera, and derivatives (N, 2, 25): `COLUMNS`.
    """
    shaped, shape_slope = shaped_points(places.points, state.shape, places.centre)
    board_turn, camera_turn = state.board_rotation[places.pose], state.camera_rotation[places.camera]
    arm = _turned(board_turn, shaped)
    turned = _turned(camera_turn, arm + state.board_translation[places.pose])
    seen = turned + state.camera_translation[places.camera]
    lens = state.lens[places.camera].T
    pixels, pixel_wrt_point, pixel_wrt_lens = _pixel_slopes(lens, seen)
    slopes = np.empty((len(seen), 2, COLUMNS))
    slopes[:, :, :LENS] = pixel_wrt_lens
    slopes[:, :, LENS : LENS + 3] = -pixel_wrt_point @ hat(turned)
    slopes[:, :, LENS + 3 : CAMERA] = pixel_wrt_point
    in_world = pixel_wrt_point @ camera_turn
    slopes[:, :, CAMERA : CAMERA + SHAPE] = in_world @ (board_turn @ shape_slope)
    slopes[:, :, CAMERA + SHAPE : CAMERA + SHAPE + 3] = -in_world @ hat(arm)
    slopes[:, :, CAMERA + SHAPE + 3 :] = in_world
    return pixels, slopes


def _turned(rotation: Floats, points: Floats) -> Floats:
    return np.asarray((rotation @ points[..., None])[..., 0])


def _distorted(lens: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Distort directions with the lens rows (9, N), as `marey.cameras.lens.distort` does."""
    k1, k2, p1, p2, k3 = lens[4:]
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    return x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y


def _pixel_slopes(lens: Floats, seen: Floats) -> tuple[Floats, Floats, Floats]:
    """Return pixels (N, 2) and their derivatives with respect to the point (N, 2, 3) and the lens (N, 2, 9)."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    inverse = 1.0 / np.where(seen[:, 2] > 0, seen[:, 2], np.nan)
    x, y = seen[:, 0] * inverse, seen[:, 1] * inverse
    s = x * x + y * y
    u, v = _distorted(lens, x, y)
    radial, slope = 1.0 + s * (k1 + s * (k2 + s * k3)), 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))
    cross = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    columns = [fx * (radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x) * inverse, fx * cross * inverse]
    rows = [fy * cross * inverse, fy * (radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x) * inverse]
    point = np.empty((len(seen), 2, 3))
    for i, (along, across) in enumerate((columns, rows)):
        point[:, i, 0], point[:, i, 1], point[:, i, 2] = along, across, -(along * x + across * y)
    own = np.zeros((len(seen), 2, LENS))
    own[:, 0, 0], own[:, 1, 1], own[:, 0, 2], own[:, 1, 3] = u, v, 1.0, 1.0
    radii = np.stack([s, s * s], axis=-1)
    own[:, 0, 4:6], own[:, 1, 4:6] = (fx * x)[:, None] * radii, (fy * y)[:, None] * radii
    own[:, 0, 6], own[:, 0, 7] = 2 * fx * x * y, fx * (s + 2 * x * x)
    own[:, 1, 6], own[:, 1, 7] = fy * (s + 2 * y * y), 2 * fy * x * y
    own[:, 0, 8], own[:, 1, 8] = fx * x * s**3, fy * y * s**3
    return np.stack([fx * u + cx, fy * v + cy], axis=-1), point, own
