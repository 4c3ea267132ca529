"""Normal equations of a calibration, and their reduction to the unknowns that all pictures share.

The board poses are eliminated by the Schur complement ([Triggs1999] section 6.1): with the normal matrix
[[B, E], [E^T, U]], in which U has one 6 x 6 block per board pose, the cameras satisfy (B - E U^-1 E^T) x = g - E
U^-1 h.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.projection import BOARD_COLUMNS, COLUMNS, LATE_COLUMN, RESIDUAL_COLUMN
from marey.calibration.adjustment.state import CAMERA, SHAPE, common_size, delay_unknowns, shape_unknowns
from marey.geometry.rotations import hat

HUBER = 2.5
"""Distance from which the weight of a corner falls, in standard deviations in two dimensions; chosen by hand."""
LOST = 1e3
"""Distance that stands for a corner behind a camera, in standard deviations; chosen by hand."""
_BEYOND = 1e12
"""Derivative or residual, in standard deviations, beyond which a corner is lost; far beyond any that matters."""
_UNKNOWN = 1e-10
"""Eigenvalue of a board pose's normal matrix, relative to the largest, below which nothing is known; by hand."""
_WEIGHT_ROUNDS = 3
"""Number of times that weights and the displacement of a view's board are estimated in turn; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewPlaces:
    """Which corners, camera and board pose belongs to each view."""

    slot: Integers
    """(N,) row of each corner in a table of V x M corners, the corners of each view in a row."""
    camera: Integers
    """(V,) camera of each view."""
    pose: Integers
    """(V,) board pose of each view."""
    loose: Mask
    """(V,) whether the board of the view may be displaced from the common pose."""
    longest: int
    """M, the largest number of corners in a view."""


def view_places(view: Integers, camera: Integers, pose: Integers) -> ViewPlaces:
    """Arrange corners by view.

    Args:
        view: (N,) view of each corner, in ascending order.
        camera: (N,) camera of each corner.
        pose: (N,) board pose of each corner.
    """
    starts = np.unique(view, return_index=True)[1]
    counts = np.diff(np.append(starts, len(view)))
    longest = int(counts.max(initial=1))
    within = np.arange(len(view)) - np.repeat(starts, counts)
    slot = np.repeat(np.arange(len(starts)), counts) * longest + within
    loose = np.ones(len(starts), bool)
    return ViewPlaces(slot=slot, camera=camera[starts], pose=pose[starts], loose=loose, longest=longest)


@dataclass(frozen=True, eq=False, kw_only=True)
class NormalBlocks:
    """Blocks of the normal equations: D common unknowns, B board poses."""

    common: Floats
    """(D, D)."""
    mixed: Floats
    """(B, D, 6)."""
    board: Floats
    """(B, 6, 6)."""
    common_right: Floats
    """(D,)."""
    board_right: Floats
    """(B, 6)."""

    def damped(self, damping: float) -> "NormalBlocks":
        """Return the blocks with their diagonals increased by a share, as Levenberg and Marquardt do."""
        common, board = self.common.copy(), self.board.copy()
        common[np.diag_indices(len(common))] *= 1.0 + damping
        corner = np.arange(6)
        board[:, corner, corner] *= 1.0 + damping
        return NormalBlocks(
            common=common, mixed=self.mixed, board=board,
            common_right=self.common_right, board_right=self.board_right,
        )  # fmt: skip

    def reduced(self) -> tuple[Floats, Floats]:
        """Eliminate the board poses.

        Returns:
            Matrix (D, D) and right-hand side (D,) of the common unknowns.
        """
        root = _inverse_roots(self.board)
        size = len(self.common)
        half = (self.mixed @ root).transpose(1, 0, 2).reshape(size, -1)
        right = (root.transpose(0, 2, 1) @ self.board_right[..., None]).ravel()
        return self.common - half @ half.T, self.common_right - half @ right

    def board_steps(self, common_step: Floats) -> Floats:
        """Return the steps (B, 6) of the board poses that belong to steps (D,) of the common unknowns."""
        right = self.board_right - np.einsum("bdk,d->bk", self.mixed, common_step)
        root = _inverse_roots(self.board)
        return np.asarray((root @ (root.transpose(0, 2, 1) @ right[..., None]))[..., 0])


def _inverse_roots(matrices: Floats) -> Floats:
    """Return R (B, 6, 6) with R R^T the inverses of symmetric matrices, zero in directions of which nothing is known.

    Such are the rotation of a wand about its stick, and that of a single point.
    """
    values, vectors = np.linalg.eigh(matrices)
    known = values > _UNKNOWN * values[:, -1:]
    return np.asarray(vectors * np.where(known, 1.0 / np.sqrt(np.where(known, values, 1.0)), 0.0)[:, None, :])


COMMON_COLUMNS = np.array([*range(CAMERA + SHAPE), LATE_COLUMN])
"""Columns of a view's rows that belong to common unknowns: its camera, the board's shape, and its delay."""


def common_columns(camera: Integers, cameras: int) -> Integers:
    """Return the common unknowns (V, 20) to which the columns `COMMON_COLUMNS` of each view belong.

    Args:
        camera: (V,) camera of each view.
        cameras: Number of cameras.
    """
    every = np.arange(common_size(cameras))
    of_camera = CAMERA * camera[:, None] + np.arange(CAMERA)
    of_shape = np.broadcast_to(every[shape_unknowns(cameras)], (len(camera), SHAPE))
    return np.concatenate([of_camera, of_shape, every[delay_unknowns(cameras)][camera][:, None]], axis=1)


def assemble(square: Floats, places: ViewPlaces, *, cameras: int, poses: int, fixed: Mask) -> NormalBlocks:
    """Add up the normal equations of all views.

    Args:
        square: (V, 27, 27) products of each view's rows, see `view_systems`.
        places: The corners' places.
        cameras: Number of cameras.
        poses: Number of board poses.
        fixed: (B,) board poses that do not change.

    Returns:
        The blocks; a pose that is fixed or never seen has the unit matrix.
    """
    size = common_size(cameras)
    board = np.arange(COLUMNS)[BOARD_COLUMNS]
    index, own = common_columns(places.camera, cameras), COMMON_COLUMNS
    common, right = np.zeros((size, size)), np.zeros(size)
    np.add.at(common, (index[:, :, None], index[:, None, :]), square[:, own][:, :, own])
    np.add.at(right, index, square[:, own, RESIDUAL_COLUMN])
    mixed, own_board, board_right = np.zeros((poses, size, 6)), np.zeros((poses, 6, 6)), np.zeros((poses, 6))
    np.add.at(mixed, (places.pose[:, None], index), square[:, own][:, :, board])
    np.add.at(own_board, places.pose, square[:, board][:, :, board])
    np.add.at(board_right, places.pose, square[:, board, RESIDUAL_COLUMN])
    still = fixed | (np.abs(own_board).sum(axis=(1, 2)) == 0)
    mixed[still], own_board[still], board_right[still] = 0.0, np.eye(6), 0.0
    return NormalBlocks(
        common=common, mixed=mixed, board=own_board, common_right=right, board_right=board_right
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewSystems:
    """What each view contributes to the normal equations."""

    square: Floats
    """(V, 27, 27) products of the weighted derivatives and residuals with themselves."""
    cost: float
    """Sum of Huber's function over all corners, and of the squares of the boards' displacements."""
    own: Floats
    """(N, 2) residuals without the part that a displacement of the board explains, in standard deviations."""
    displacement: Floats
    """(V, 6) rotation about the board's centre and translation of each view's board, in standard deviations."""


def view_systems(rows: Floats, places: ViewPlaces, arm: Floats, spread: tuple[float, float]) -> ViewSystems:
    """Weigh the corners of each view, and eliminate the displacement of its board.

    Cameras that are not exactly synchronous see the board in slightly different poses. The board of each view is
    displaced from the common pose by d, with standard deviations S of rotation and translation; with derivatives J,
    elimination of d replaces the product A^T A by A^T A - A^T J (S^-2 + J^T J)^-1 J^T A.

    Args:
        rows: (N, 2, 27) derivatives and residuals in standard deviations of the corners.
        places: The corners' places.
        arm: (V, 3) from the board's origin to its centre, in world axes [m].
        spread: Standard deviations of the boards' rotation [rad] and translation [m]; both may be zero.

    Returns:
        The contributions; corners beyond Huber's distance have less weight.
    """
    views, width = len(places.camera), rows.shape[-1]
    table = np.zeros((views * places.longest, 2, width))
    with np.errstate(invalid="ignore"):
        lost = ~(np.abs(rows).max(axis=(1, 2)) < _BEYOND)
    table[places.slot] = np.where(lost[:, None, None], 0.0, rows)
    table = table.reshape(views, -1, width)
    board = table[:, :, BOARD_COLUMNS]
    turn = board[:, :, :3] + board[:, :, 3:] @ hat(arm)
    loose = np.concatenate([turn * spread[0], board[:, :, 3:] * spread[1]], axis=-1) * places.loose[:, None, None]
    weight = np.ones((views, places.longest))
    residual = table[:, :, RESIDUAL_COLUMN]
    displacement = np.zeros((views, 6))
    for _ in range(_WEIGHT_ROUNDS if max(spread) > 0 else 1):
        both = np.repeat(weight, 2, axis=1)[:, :, None]
        normal = np.eye(6) + loose.transpose(0, 2, 1) @ (both * loose)
        right = loose.transpose(0, 2, 1) @ (both * residual[:, :, None])
        displacement = np.linalg.solve(normal, right)[..., 0]
        own = (residual - (loose @ displacement[..., None])[..., 0]).reshape(views, -1, 2)
        length = np.linalg.norm(own, axis=-1)
        weight = np.where(length > HUBER, HUBER / np.where(length > 0, length, 1.0), 1.0)
    both = np.sqrt(np.repeat(weight, 2, axis=1))[:, :, None]
    table, loose = table * both, loose * both
    square = table.transpose(0, 2, 1) @ table
    if max(spread) > 0:
        across = table.transpose(0, 2, 1) @ loose
        inner = np.linalg.inv(np.eye(6) + loose.transpose(0, 2, 1) @ loose)
        square = square - across @ inner @ across.transpose(0, 2, 1)
    flat = length.reshape(-1)[places.slot]
    flat = np.where(lost, LOST, flat)
    cost = np.where(flat < HUBER, flat**2, HUBER * (2 * flat - HUBER)).sum() + np.square(displacement).sum()
    separate = np.where(lost[:, None], LOST, own.reshape(-1, 2)[places.slot])
    return ViewSystems(square=square, cost=float(cost), own=separate, displacement=displacement)
