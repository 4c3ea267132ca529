"""Projection of board corners, with the derivatives with respect to all unknowns."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.state import CAMERA, LENS, SHAPE, SessionState, shaped_points
from marey.compiled.kernels import kernel

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
    pixels, slopes = np.empty((len(shaped), 2)), np.empty((len(shaped), 2, COLUMNS))
    _project_with_slopes(
        state.lens, state.camera_rotation, state.camera_translation, state.board_rotation, state.board_translation,
        places.camera, places.pose, shaped, shape_slope, pixels, slopes,
    )  # fmt: skip
    return pixels, slopes


@kernel
def _project_with_slopes(
    lens, camera_rotation, camera_translation, board_rotation, board_translation, camera, pose, shaped, shape_slope,
    pixels, slopes,
):  # fmt: skip
    """Write pixels (N, 2) and derivatives (N, 2, 25).

    The arguments before them are fields of a `SessionState`, the cameras and board poses (N,) of the corners, and their
    places on the board (N, 3) with the derivatives (N, 3, 4) by its shape.
    """
    arm, turned, in_world = np.empty(3), np.empty(3), np.empty(3)
    point, own = np.empty((2, 3)), np.empty((2, LENS))
    for n in range(len(camera)):
        turn, board = camera_rotation[camera[n]], board_rotation[pose[n]]
        for i in range(3):
            arm[i] = board[i, 0] * shaped[n, 0] + board[i, 1] * shaped[n, 1] + board[i, 2] * shaped[n, 2]
            in_world[i] = arm[i] + board_translation[pose[n], i]
        for i in range(3):
            turned[i] = turn[i, 0] * in_world[0] + turn[i, 1] * in_world[1] + turn[i, 2] * in_world[2]
        shift = camera_translation[camera[n]]
        _pixel_slopes(
            lens[camera[n]], turned[0] + shift[0], turned[1] + shift[1], turned[2] + shift[2], pixels[n], point, own
        )
        for r in range(2):
            row, by_point = slopes[n, r], point[r]
            row[:LENS] = own[r]
            _write_turn_and_shift(row, LENS, by_point, turned)
            for i in range(3):
                in_world[i] = by_point[0] * turn[0, i] + by_point[1] * turn[1, i] + by_point[2] * turn[2, i]
            for k in range(SHAPE):
                total = 0.0
                for i in range(3):
                    for j in range(3):
                        total += in_world[i] * board[i, j] * shape_slope[n, j, k]
                row[CAMERA + k] = total
            _write_turn_and_shift(row, CAMERA + SHAPE, in_world, arm)


@kernel
def _write_turn_and_shift(row, column, by_point, arm):
    """Write the derivatives (6,) by a rotation on the left of an arm (3,), -by_point [arm]x, and by a translation."""
    row[column] = by_point[2] * arm[1] - by_point[1] * arm[2]
    row[column + 1] = by_point[0] * arm[2] - by_point[2] * arm[0]
    row[column + 2] = by_point[1] * arm[0] - by_point[0] * arm[1]
    row[column + 3 : column + 6] = by_point


@kernel
def _pixel_slopes(lens, seen_x, seen_y, seen_z, pixel, point, own):
    """Write the pixel (2,) of a point in camera axes, and its derivatives by the point (2, 3) and the lens (2, 9)."""
    fx, fy, k1, k2, p1, p2, k3 = lens[0], lens[1], lens[4], lens[5], lens[6], lens[7], lens[8]
    inverse = 1.0 / seen_z if seen_z > 0 else np.nan
    x, y = seen_x * inverse, seen_y * inverse
    s = x * x + y * y
    radial, slope = 1.0 + s * (k1 + s * (k2 + s * k3)), 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    v = y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    cross = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    pixel[0], pixel[1] = fx * u + lens[2], fy * v + lens[3]
    point[0, 0] = fx * (radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x) * inverse
    point[0, 1] = fx * cross * inverse
    point[1, 0] = fy * cross * inverse
    point[1, 1] = fy * (radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x) * inverse
    own[:] = 0.0
    own[0, 0], own[1, 1], own[0, 2], own[1, 3] = u, v, 1.0, 1.0
    for r, along in ((0, fx * x), (1, fy * y)):
        point[r, 2] = -(point[r, 0] * x + point[r, 1] * y)
        own[r, 4], own[r, 5], own[r, 8] = along * s, along * s * s, along * s * s * s
    own[0, 6], own[0, 7] = 2.0 * fx * x * y, fx * (s + 2.0 * x * x)
    own[1, 6], own[1, 7] = fy * (s + 2.0 * y * y), 2.0 * fy * x * y


def _turned(rotation: Floats, points: Floats) -> Floats:
    return np.asarray((rotation @ points[..., None])[..., 0])


def _distorted(lens: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Distort directions with the lens rows (9, N), as `marey.cameras.lens.distort` does."""
    k1, k2, p1, p2, k3 = lens[4:]
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    return x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y
