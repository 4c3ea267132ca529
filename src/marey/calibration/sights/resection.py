"""The pose of one camera, or of a board before it, from views that contradict the others."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from marey.arrays import Floats
from marey.calibration.adjustment.projection import CornerPlaces, project_corners
from marey.calibration.adjustment.solve import SolvedSession
from marey.calibration.adjustment.start import plane_poses
from marey.calibration.adjustment.state import SessionState
from marey.calibration.boards.corners import CornerSet
from marey.geometry.rigid import RigidTransform

_LOSS_PX = 1.0
"""Residual from which a corner counts less in a resection [px]; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Resected:
    """A pose found from some views of one camera."""

    camera_from_world: RigidTransform
    """Pose of the camera; with an unknown board the world is that of the board."""
    rms_px: float
    """Median distance of the corners from their predictions over its expectation for unit noise [px]."""

    def displacement(self, state: SessionState, camera: int) -> tuple[float, float]:
        """Return by which angle [deg] and distance [m] the camera is displaced from its pose in a state."""
        old = RigidTransform(state.camera_rotation[camera], state.camera_translation[camera])
        turn = np.linalg.norm((self.camera_from_world @ old.inverse()).rotation_vector)
        shift = self.camera_from_world.inverse().translation - old.inverse().translation
        return float(np.degrees(turn)), float(np.linalg.norm(shift))


def resect_camera(
    solved: SolvedSession, corners: CornerSet, camera: int, *, boards: Mapping[int, RigidTransform] | None
) -> Resected | None:
    """Estimate the pose of a camera from some of its views, with its lens.

    Args:
        solved: The solved session, with the lenses.
        corners: Corners of this camera alone.
        camera: Index of the camera.
        boards: Pose of the board in the world for each picture; None if all corners show one board, whose frame is
            then the world.

    Returns:
        The pose; None if there are too few corners.
    """
    problem, state = solved.adjusted.problem, solved.state
    if len(corners) < 4:
        return None
    poses = boards if boards is not None else dict.fromkeys(corners.picture.tolist(), RigidTransform.identity())
    numbers = {picture: k for k, picture in enumerate(poses)}
    pose = np.array([numbers[picture] for picture in corners.picture.tolist()], np.int64)
    turn, shift = (np.stack([getattr(each, key) for each in poses.values()]) for key in ("rotation", "translation"))
    places = CornerPlaces(
        camera=np.zeros(len(corners), np.int64), pose=pose, points=problem.board.points[corners.corner],
        centre=problem.board.centre,
    )  # fmt: skip
    starts = [
        found @ poses[int(corners.view_picture[view])].inverse()
        for view in range(len(corners.view_starts))
        for found in plane_poses(corners, problem.board, state.lens, view)
    ]
    if not starts:
        return None

    def residual(vector: Floats, start: RigidTransform) -> Floats:
        moved = RigidTransform.from_vector(vector[:3], vector[3:]) @ start
        own = SessionState(
            lens=state.lens[camera : camera + 1], camera_rotation=moved.rotation[None],
            camera_translation=moved.translation[None], board_rotation=turn, board_translation=shift,
            shape=state.shape, delay=np.zeros(1),
        )  # fmt: skip
        apart = corners.pixels - project_corners(own, places)[0]
        return np.nan_to_num(apart, nan=1e3).ravel()

    best = min(starts, key=lambda start: float(np.median(np.abs(residual(np.zeros(6), start)))))
    found = scipy.optimize.least_squares(residual, np.zeros(6), args=(best,), loss="soft_l1", f_scale=_LOSS_PX)
    apart = np.linalg.norm(residual(found.x, best).reshape(-1, 2), axis=1)
    moved = RigidTransform.from_vector(found.x[:3], found.x[3:]) @ best
    return Resected(camera_from_world=moved, rms_px=float(np.median(apart)) / 1.1774)
