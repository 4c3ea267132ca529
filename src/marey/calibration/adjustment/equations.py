"""Normal equations of a calibration, and their reduction to the unknowns that all pictures share.

The board poses are eliminated by the Schur complement ([Triggs1999] section 6.1): with the normal matrix
[[B, E], [E^T, U]], in which U has one 6 x 6 block per board pose, the cameras satisfy (B - E U^-1 E^T) x = g - E U^-1 h.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.projection import BOARD_COLUMNS, COLUMNS
from marey.calibration.adjustment.state import CAMERA, SHAPE


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewPlaces:
    """Which corners, camera and board pose belongs to each view."""

    slot: Integers
    """(N,) row of each corner in a table of V x M corners, the corners of each view in a row."""
    camera: Integers
    """(V,) camera of each view."""
    pose: Integers
    """(V,) board pose of each view."""
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
    return ViewPlaces(slot=slot, camera=camera[starts], pose=pose[starts], longest=longest)


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
        across = self.mixed @ np.linalg.inv(self.board)
        size = len(self.common)
        flat, own = across.transpose(1, 0, 2).reshape(size, -1), self.mixed.transpose(1, 0, 2).reshape(size, -1)
        return self.common - flat @ own.T, self.common_right - flat @ self.board_right.ravel()

    def board_steps(self, common_step: Floats) -> Floats:
        """Return the steps (B, 6) of the board poses that belong to steps (D,) of the common unknowns."""
        right = self.board_right - np.einsum("bdk,d->bk", self.mixed, common_step)
        return np.asarray(np.linalg.solve(self.board, right[..., None])[..., 0])


def assemble(rows: Floats, places: ViewPlaces, *, cameras: int, poses: int, fixed: Mask) -> NormalBlocks:
    """Add up the normal equations of all corners.

    Args:
        rows: (N, 2, 26) weighted derivatives, and the weighted residual in the last column.
        places: The corners' places.
        cameras: Number of cameras.
        poses: Number of board poses.
        fixed: (B,) board poses that do not change.

    Returns:
        The blocks; a pose that is fixed or never seen has the unit matrix.
    """
    square = view_squares(rows, places)
    size = CAMERA * cameras + SHAPE
    shape, board = np.arange(CAMERA, CAMERA + SHAPE), np.arange(COLUMNS)[BOARD_COLUMNS]
    of_camera = CAMERA * places.camera[:, None] + np.arange(CAMERA)
    index = np.concatenate([of_camera, np.broadcast_to(CAMERA * cameras + np.arange(SHAPE), (len(square), SHAPE))], 1)
    own = np.concatenate([np.arange(CAMERA), shape])
    common, right = np.zeros((size, size)), np.zeros(size)
    np.add.at(common, (index[:, :, None], index[:, None, :]), square[:, own][:, :, own])
    np.add.at(right, index, square[:, own, COLUMNS])
    mixed, own_board, board_right = np.zeros((poses, size, 6)), np.zeros((poses, 6, 6)), np.zeros((poses, 6))
    np.add.at(mixed, (places.pose[:, None], index), square[:, own][:, :, board])
    np.add.at(own_board, places.pose, square[:, board][:, :, board])
    np.add.at(board_right, places.pose, square[:, board, COLUMNS])
    still = fixed | (np.abs(own_board).sum(axis=(1, 2)) == 0)
    mixed[still], own_board[still], board_right[still] = 0.0, np.eye(6), 0.0
    return NormalBlocks(
        common=common, mixed=mixed, board=own_board, common_right=right, board_right=board_right
    )  # fmt: skip


def view_squares(rows: Floats, places: ViewPlaces) -> Floats:
    """Return the products (V, 26, 26) of the rows (N, 2, 26) of each view with themselves."""
    views, width = len(places.camera), rows.shape[-1]
    table = np.zeros((views * places.longest, 2, width))
    table[places.slot] = rows
    table = table.reshape(views, -1, width)
    return np.asarray(table.transpose(0, 2, 1) @ table)
