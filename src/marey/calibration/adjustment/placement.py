"""The pose of the board in one picture, from some of its views."""

from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.projection import (
    BOARD_COLUMNS,
    CornerPlaces,
    project_corners,
    project_corners_with_derivative,
)
from marey.calibration.adjustment.start import plane_poses
from marey.calibration.adjustment.state import SessionState
from marey.calibration.adjustment.wand_start import with_wand_poses
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationTarget, CalibrationWand
from marey.geometry.rigid import RigidTransform

_LOSS_PX = 1.0
"""Residual from which a corner counts less [px]; chosen by hand."""
_BEHIND_PX = 1e3
"""Residual that stands for a corner behind a camera [px]; chosen by hand."""
_MOST_STEPS = 40
"""Largest number of steps; chosen by hand."""
_FIRST_DAMPING, _GREATEST_DAMPING = 1e-4, 1e6
"""First damping as a share of the diagonal, and that at which the steps end; chosen by hand."""
_LEAST_GAIN = 1e-6
"""Relative gain of the cost that ends the steps; chosen by hand."""


def place_board(
    board: CalibrationTarget, state: SessionState, corners: CornerSet, cameras: Integers
) -> tuple[RigidTransform, float] | None:
    """Find the board pose of one picture from some of its views.

    Args:
        board: The board.
        state: The cameras.
        corners: Corners of one picture.
        cameras: (N,) the camera that each corner is attributed to, which may be another than its own.

    Returns:
        Pose of the board in the world and the median distance of the corners from it [px], or None.
    """
    order = np.argsort(cameras, kind="stable")
    changed = replace(corners.ordered(order), camera=cameras[order])
    starts = _starts(board, state, changed)
    if not starts:
        return None
    places = CornerPlaces(
        camera=changed.camera, pose=np.zeros(len(changed), np.int64), points=board.points[changed.corner],
        centre=board.centre,
    )  # fmt: skip

    tried = [_at(state, start) for start in starts]
    best = min(tried, key=lambda each: float(np.abs(_residual(each, places, changed)).mean()))
    found = _refined(best, places, changed)
    apart = np.linalg.norm(_residual(found, places, changed), axis=1)
    return found.board_pose(0), float(np.median(apart))


def _at(state: SessionState, pose: RigidTransform) -> SessionState:
    return replace(state, board_rotation=pose.rotation[None], board_translation=pose.translation[None])


def _residual(state: SessionState, places: CornerPlaces, corners: CornerSet) -> Floats:
    return np.nan_to_num(corners.pixels - project_corners(state, places)[0], nan=_BEHIND_PX)


def _cost(residual: Floats) -> float:
    """Return the sum of a robust function of all coordinates: nearly linear beyond `_LOSS_PX`."""
    return float(np.sum(np.sqrt(1.0 + np.square(residual / _LOSS_PX)) - 1.0))


def _refined(state: SessionState, places: CornerPlaces, corners: CornerSet) -> SessionState:
    """Refine the one board pose of a state by Levenberg-Marquardt steps."""
    cost, damping = _cost(_residual(state, places, corners)), _FIRST_DAMPING
    for _ in range(_MOST_STEPS):
        pixels, slopes = project_corners_with_derivative(state, places)
        residual = (corners.pixels - pixels).ravel()
        slope = slopes[..., BOARD_COLUMNS].reshape(-1, 6)
        good = np.isfinite(residual) & np.isfinite(slope).all(axis=1)
        residual, slope = residual[good], slope[good]
        weighted = slope / np.sqrt(1.0 + np.square(residual / _LOSS_PX))[:, None]
        normal, right = weighted.T @ slope, weighted.T @ residual
        damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
        # Nothing determines the rotation of a wand about its stick.
        step = np.linalg.lstsq(damped, right, rcond=None)[0]
        trial = state.stepped(np.zeros(state.size), step[None])
        new = _cost(_residual(trial, places, corners))
        if new < cost:
            settled = cost - new < _LEAST_GAIN * cost
            state, cost, damping = trial, new, damping / 10.0
            if settled:
                break
        elif damping > _GREATEST_DAMPING:
            break
        else:
            damping *= 10.0
    return state


def _starts(board: CalibrationTarget, state: SessionState, corners: CornerSet) -> list[RigidTransform]:
    """Return approximate poses of the board in one picture: of each view, or of a wand by triangulation."""
    if isinstance(board, CalibrationWand):
        alone = replace(corners, picture=np.zeros(len(corners), np.int64), pictures=corners.pictures[:1])
        cameras = np.zeros(state.cameras, np.int64)
        one = replace(state, board_rotation=np.eye(3)[None], board_translation=np.zeros((1, 3)))
        placed, seen = with_wand_poses(one, alone, board, cameras)
        return [placed.board_pose(0)] if seen[0] else []
    return [
        RigidTransform(state.camera_rotation[camera], state.camera_translation[camera]).inverse() @ found
        for view, camera in enumerate(corners.view_camera)
        for found in plane_poses(corners, board, state.lens, view)
    ]
