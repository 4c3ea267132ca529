"""The pose of the board in one picture, from some of its views."""

from dataclasses import replace

import numpy as np
import scipy.optimize

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.projection import CornerPlaces, project_corners
from marey.calibration.adjustment.start import plane_poses
from marey.calibration.adjustment.state import SessionState
from marey.calibration.adjustment.wand_start import with_wand_poses
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationTarget, CalibrationWand
from marey.geometry.rigid import RigidTransform

_LOSS_PX = 1.0
"""Residual from which a corner counts less [px]; chosen by hand."""


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

    def residual(vector: Floats, start: RigidTransform) -> Floats:
        moved = start @ RigidTransform.from_vector(vector[:3], vector[3:])
        own = replace(
            state, board_rotation=moved.rotation[None], board_translation=moved.translation[None]
        )  # fmt: skip
        return np.nan_to_num(changed.pixels - project_corners(own, places)[0], nan=1e3).ravel()

    best = min(starts, key=lambda start: float(np.abs(residual(np.zeros(6), start)).mean()))
    found = scipy.optimize.least_squares(residual, np.zeros(6), args=(best,), loss="soft_l1", f_scale=_LOSS_PX)
    apart = np.linalg.norm(residual(found.x, best).reshape(-1, 2), axis=1)
    return best @ RigidTransform.from_vector(found.x[:3], found.x[3:]), float(np.median(apart))


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
