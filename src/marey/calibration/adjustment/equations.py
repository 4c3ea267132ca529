"""Normal equations of a calibration, and their reduction to the unknowns that all pictures share.

The board poses are eliminated by the Schur complement ([Triggs1999] section 6.1): with the normal matrix
[[B, E], [E^T, U]], in which U has one 6 x 6 block per board pose, the cameras satisfy (B - E U^-1 E^T) x = g - E
U^-1 h.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.projection import LATE_COLUMN
from marey.calibration.adjustment.state import CAMERA, SHAPE, common_size, delay_unknowns, shape_unknowns
from marey.compiled.kernels import kernel

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

    starts: Integers
    """(V + 1,) first corner of each view, and the number of corners."""
    camera: Integers
    """(V,) camera of each view."""
    pose: Integers
    """(V,) board pose of each view."""
    loose: Mask
    """(V,) whether the board of the view may be displaced from the common pose."""


def view_places(view: Integers, camera: Integers, pose: Integers) -> ViewPlaces:
    """Arrange corners by view.

    Args:
        view: (N,) view of each corner, in ascending order.
        camera: (N,) camera of each corner.
        pose: (N,) board pose of each corner.
    """
    first = np.unique(view, return_index=True)[1]
    return ViewPlaces(
        starts=np.append(first, len(view)), camera=camera[first], pose=pose[first], loose=np.ones(len(first), bool)
    )


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

    @cached_property
    def _roots(self) -> Floats:
        return _inverse_roots(self.board)

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
        root, size = self._roots, len(self.common)
        half = (self.mixed @ root).transpose(1, 0, 2).reshape(size, -1)
        right = (root.transpose(0, 2, 1) @ self.board_right[..., None]).ravel()
        return self.common - half @ half.T, self.common_right - half @ right

    def board_steps(self, common_step: Floats) -> Floats:
        """Return the steps (B, 6) of the board poses that belong to steps (D,) of the common unknowns."""
        right, root = self.board_right - common_step @ self.mixed, self._roots
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
    common, right = np.zeros((size, size)), np.zeros(size)
    mixed, own_board, board_right = np.zeros((poses, size, 6)), np.zeros((poses, 6, 6)), np.zeros((poses, 6))
    _add_views(
        square, common_columns(places.camera, cameras), COMMON_COLUMNS, places.pose, common, right, mixed, own_board,
        board_right,
    )  # fmt: skip
    still = fixed | (np.abs(own_board).sum(axis=(1, 2)) == 0)
    mixed[still], own_board[still], board_right[still] = 0.0, np.eye(6), 0.0
    return NormalBlocks(
        common=common, mixed=mixed, board=own_board, common_right=right, board_right=board_right
    )  # fmt: skip


@kernel
def _add_views(square, index, own, pose, common, right, mixed, board, board_right):
    """Add the products (V, 27, 27) of the views' rows to the blocks of their unknowns; `own` are the common columns."""
    first = own[0] + CAMERA + SHAPE
    last = square.shape[1] - 1
    for v in range(square.shape[0]):
        part, p = square[v], pose[v]
        for i in range(len(own)):
            row, a = part[own[i]], index[v, i]
            for j in range(len(own)):
                common[a, index[v, j]] += row[own[j]]
            for j in range(6):
                mixed[p, a, j] += row[first + j]
            right[a] += row[last]
        for i in range(6):
            for j in range(6):
                board[p, i, j] += part[first + i, first + j]
            board_right[p, i] += part[first + i, last]


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
    views = len(places.camera)
    with np.errstate(invalid="ignore"):
        lost = ~(np.abs(rows).max(axis=(1, 2)) < _BEYOND)
    rows = np.where(lost[:, None, None], 0.0, rows)
    square, displacement = np.empty((views, rows.shape[-1], rows.shape[-1])), np.zeros((views, 6))
    own = np.empty((len(rows), 2))
    _weigh_views(
        rows, places.starts, arm, places.loose, float(spread[0]), float(spread[1]), square, own, displacement
    )  # fmt: skip
    own[lost] = LOST
    flat = np.where(lost, LOST, np.linalg.norm(own, axis=1))
    cost = np.where(flat < HUBER, flat**2, HUBER * (2 * flat - HUBER)).sum() + np.square(displacement).sum()
    return ViewSystems(square=square, cost=float(cost), own=own, displacement=displacement)


@kernel
def _weigh_views(rows, starts, arm, loose, turn_sd, shift_sd, square, own, displacement):
    """Write the products (V, 27, 27), the residuals (N, 2) and the displacements (V, 6) of `view_systems`."""
    width = rows.shape[2]
    for v in range(len(starts) - 1):
        first, count = starts[v], starts[v + 1] - starts[v]
        part = rows[first : starts[v + 1]].reshape(2 * count, width)
        weight, moves = np.ones(count), loose[v] and max(turn_sd, shift_sd) > 0.0
        across = _displaced(part, arm[v], turn_sd, shift_sd)
        for _ in range(_WEIGHT_ROUNDS if moves else 1):
            if moves:
                normal, right = _displacement_equations(across, part[:, width - 1], weight)
                displacement[v] = np.linalg.solve(normal, right)
            for n in range(count):
                for k in range(2):
                    moved = 0.0
                    for i in range(6):
                        moved += across[2 * n + k, i] * displacement[v, i]
                    own[first + n, k] = part[2 * n + k, width - 1] - moved
                length = np.hypot(own[first + n, 0], own[first + n, 1])
                weight[n] = HUBER / length if length > HUBER else 1.0
        weighted = np.empty_like(part)
        for n in range(2 * count):
            weighted[n] = part[n] * weight[n // 2]
        square[v] = part.T @ weighted
        if moves:
            normal, _ = _displacement_equations(across, part[:, width - 1], weight)
            both = across.T @ weighted
            square[v] -= both.T @ np.linalg.solve(normal, both)


@kernel
def _displaced(rows, arm, turn_sd, shift_sd):
    """Return the derivatives (2n, 6) of a view's rows by its board's displacement in standard deviations."""
    found, first = np.empty((len(rows), 6)), CAMERA + SHAPE
    for n in range(len(rows)):
        turn, shift = rows[n, first : first + 3], rows[n, first + 3 : first + 6]
        found[n, 0] = turn_sd * (turn[0] + shift[1] * arm[2] - shift[2] * arm[1])
        found[n, 1] = turn_sd * (turn[1] + shift[2] * arm[0] - shift[0] * arm[2])
        found[n, 2] = turn_sd * (turn[2] + shift[0] * arm[1] - shift[1] * arm[0])
        for i in range(3):
            found[n, 3 + i] = shift_sd * shift[i]
    return found


@kernel
def _displacement_equations(across, residual, weight):
    """Return the normal matrix (6, 6) and the right-hand side (6,) of a displacement with a prior of unit variance."""
    normal, right = np.eye(6), np.zeros(6)
    for n in range(len(across)):
        for i in range(6):
            weighted = weight[n // 2] * across[n, i]
            right[i] += weighted * residual[n]
            for j in range(6):
                normal[i, j] += weighted * across[n, j]
    return normal, right
