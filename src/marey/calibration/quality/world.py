"""The world frame of a calibration: from the board on the floor, or level with the cameras."""

from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.adjustment.adjust import Adjusted, adjust
from marey.calibration.adjustment.covariance import common_covariance, free_covariance
from marey.calibration.adjustment.equations import COMMON_COLUMNS, common_columns
from marey.calibration.adjustment.solve import SolvedSession
from marey.calibration.adjustment.state import CAMERA, LENS, LENS_NAMES, SessionState
from marey.calibration.boards.still import StillGroups
from marey.geometry.rigid import RigidTransform
from marey.geometry.rotations import hat
from marey.geometry.vectors import unit

WORLD_FROM_FLOOR_BOARD = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
"""Pose of the board on the floor: first corner the origin, x along the world's x, y along its -y; Z points up."""
_FLOOR_VIEW_SD = 0.03
"""Standard deviation of a shift that all corners of a view of the board on the floor share [px]: all its pictures count
as one, so that no scatter between pictures shows it. The most probable value for the worlds of the seven rendered
sessions of `bench run capture/calibration floor`, 0.027 to 0.033 without one of them."""
_CENTRE = np.array([LENS_NAMES.index("cx"), LENS_NAMES.index("cy")])
"""Columns of the derivatives by the image centre, which shifts all corners of a view."""
_LEAST_STILL = 3
"""Least number of still pictures in a row that count as a board on the floor; chosen by hand."""
_ABOVE = 0.9
"""Share of the other pictures whose boards must lie above a board on the floor; chosen by hand."""
_TOLERANCE = 0.03
"""Depth below the floor at which a board still counts as lying on it [m]; chosen by hand."""


def find_floor(solved: SolvedSession, still: StillGroups) -> int | None:
    """Find the run of still pictures in which the board lies on the floor.

    It is the longest run of at least three pictures below which no camera stands and hardly any other board lies.

    Args:
        solved: The solved session.
        still: Its runs of still pictures.

    Returns:
        The first picture of the run; None if there is none.
    """
    known = set(np.unique(solved.corners.picture).tolist())
    runs = sorted(still.runs(), key=lambda run: (run[0] - run[1], -run[1]))
    for first, last in runs:
        if last - first + 1 >= _LEAST_STILL and first in known and _lies_below(solved, first):
            return first
    return None


def _lies_below(solved: SolvedSession, picture: int) -> bool:
    """Return whether all cameras and most boards are above the board of a picture."""
    moved = solved.state.moved(WORLD_FROM_FLOOR_BOARD @ solved.state.board_pose(picture).inverse())
    return _above(moved, solved, np.setdiff1d(np.unique(solved.corners.picture), [picture]))


def boards_lie_above(solved: SolvedSession) -> bool:
    """Return whether all cameras and most boards are above the floor of a session.

    Args:
        solved: The session in the world of its floor.
    """
    return _above(solved.state, solved, np.unique(solved.corners.picture))


def _above(state: SessionState, solved: SolvedSession, pictures: Integers) -> bool:
    boards = state.board_translation[pictures] + state.board_rotation[pictures] @ solved.adjusted.problem.board.centre
    return bool(np.all(centres(state)[:, 2] > 0) and np.mean(boards[:, 2] > -_TOLERANCE) >= _ABOVE)


def centres(state: SessionState) -> Floats:
    """Return the centres of projection (C, 3) [m]."""
    return np.asarray(-np.einsum("cji,cj->ci", state.camera_rotation, state.camera_translation))


def in_floor_world(solved: SolvedSession, picture: int) -> SolvedSession:
    """Bring a solved session to the world of the board on the floor, with the covariances in that world.

    Args:
        solved: The solved session.
        picture: A picture of the board on the floor.

    Returns:
        The session; its covariance contains the uncertainty of the floor. Cameras that nothing connects with the floor
        keep the pose of one of them.
    """
    problem = solved.adjusted.problem
    moved = solved.state.moved(WORLD_FROM_FLOOR_BOARD @ solved.state.board_pose(picture).inverse())
    free = problem.free.copy()
    poses = free[: CAMERA * moved.cameras].reshape(-1, CAMERA)
    on_floor = solved.joined[problem.corners.camera[problem.corners.picture == picture]]
    seeing = np.isin(np.arange(moved.cameras), problem.corners.camera)
    poses[seeing & np.isin(solved.joined, on_floor), LENS:] = True
    fixed = problem.fixed_pose.copy()
    fixed[problem.pose[picture]] = True
    found = adjust(replace(problem, free=free, fixed_pose=fixed), moved, rounds=2)
    return replace(solved, adjusted=found, covariance=common_covariance(found) + _of_floor_views(found, picture))


def _of_floor_views(adjusted: Adjusted, picture: int) -> Floats:
    """Return what shifts of the views of the floor add to the covariance of the common unknowns."""
    problem, cameras = adjusted.problem, adjusted.state.cameras
    views = np.flatnonzero(problem.views.pose == problem.pose[picture])
    pull = np.zeros((len(problem.free), len(views), 2))
    columns = common_columns(problem.views.camera[views], cameras)
    for number, (square, own) in enumerate(zip(adjusted.systems.square[views], columns, strict=True)):
        pull[own, number] = square[np.ix_(COMMON_COLUMNS, _CENTRE)]
    change = np.zeros((len(problem.free), 2 * len(views)))
    change[problem.free] = _FLOOR_VIEW_SD * free_covariance(adjusted) @ pull[problem.free].reshape(-1, 2 * len(views))
    return np.asarray(change @ change.T)


def in_level_world(solved: SolvedSession) -> SolvedSession:
    """Bring a solved session to a world whose Z is up on average in the images, near what all cameras look at.

    The origin is the point nearest to all optical axes; x points to the right of the first camera. The covariance is
    that about the best fit of all cameras, since nothing determines this world better.

    Args:
        solved: The solved session.
    """
    state = solved.state
    ahead, centre = state.camera_rotation[:, 2], centres(state)
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    normal = across.sum(axis=0) + 1e-6 * np.eye(3)
    origin = np.linalg.solve(normal, np.einsum("cij,cj->i", across, centre) + 1e-6 * centre.mean(axis=0))
    up = unit(-state.camera_rotation[:, 1].mean(axis=0))
    right = unit(state.camera_rotation[0, 0] - (state.camera_rotation[0, 0] @ up) * up)
    rotation = np.stack([right, np.cross(up, right), up])
    moved = state.moved(RigidTransform(rotation, -rotation @ origin))
    adjusted = replace(solved.adjusted, state=moved)
    turned = _turned_covariance(solved.covariance, state, moved)
    return replace(solved, adjusted=adjusted, covariance=centred_covariance(turned, moved))


def _turned_covariance(covariance: Floats, before: SessionState, after: SessionState) -> Floats:
    """Return the covariance in another world frame: translations of cameras change with their rotations.

    With t' = t + R b, a left increment w of R changes t' by w x (R b).
    """
    change = np.eye(len(covariance))
    for camera in range(before.cameras):
        shift = after.camera_translation[camera] - before.camera_translation[camera]
        start = CAMERA * camera + LENS
        change[start + 3 : start + 6, start : start + 3] = -hat(shift)
    return np.asarray(change @ covariance @ change.T)


def centred_covariance(covariance: Floats, state: SessionState) -> Floats:
    """Return the covariance of the cameras about the rigid motion that fits all of them best.

    Args:
        covariance: (16 C + 4, 16 C + 4) in the frame of some camera, or of the floor.
        state: The cameras.

    Returns:
        The same with the six motions of the whole removed, in the metric of the distances between the cameras.
    """
    size = len(covariance)
    free, metric = np.zeros((size, 6)), np.zeros((6 * state.cameras, size))
    scale = max(float(np.ptp(centres(state), axis=0).max()), 0.1)
    for camera in range(state.cameras):
        start, rotation = CAMERA * camera + LENS, state.camera_rotation[camera]
        free[start : start + 3, :3] = -rotation
        free[start + 3 : start + 6, 3:] = -rotation
        metric[6 * camera : 6 * camera + 3, start : start + 3] = scale * np.eye(3)
        metric[6 * camera + 3 : 6 * camera + 6, start : start + 6] = centre_slope(state, camera)
    weighted = metric.T @ metric
    project = np.eye(size) - free @ np.linalg.solve(free.T @ weighted @ free, free.T @ weighted)
    return np.asarray(project @ covariance @ project.T)


def centre_slope(state: SessionState, camera: int) -> Floats:
    """Return the derivative (3, 6) of a camera's centre with respect to its rotation [rad] and translation [m]."""
    back = state.camera_rotation[camera].T
    return np.concatenate([-back @ hat(state.camera_translation[camera]), -back], axis=1)


def known_pictures(adjusted: Adjusted) -> Integers:
    """Return the pictures whose board pose was adjusted."""
    return np.unique(adjusted.problem.corners.picture)
