"""The views of one camera against the boards that the other cameras see, as quadratic forms of what may be wrong.

Every view of the camera is predicted from the pose of the board that the other cameras of the picture determine. The
normal equations of its corners, from which the pose of the board is eliminated with its covariance, are the cost of the
view as a function of changes of the camera, its clock and its shutter.
"""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.calibration.adjustment.adjust import adjust, whitening
from marey.calibration.adjustment.problem import session_problem
from marey.calibration.adjustment.projection import BOARD_COLUMNS, CornerPlaces, project_corners_with_derivative
from marey.calibration.adjustment.solve import SolvedSession
from marey.calibration.adjustment.state import CAMERA, LENS, SessionState
from marey.calibration.boards.corners import CornerSet
from marey.geometry import rotations

ZOOM, DELAY, READOUT = CAMERA, CAMERA + 1, CAMERA + 2
"""Columns behind the 15 of the camera: ratio of both focal lengths, delay [pictures], and time from the first to the
last row of a picture [pictures]."""
CHANGES = CAMERA + 3
"""Number of changes of which the cost of a view is a function."""
_LEAST_KNOWN = 1e-9
"""Eigenvalue of the normal matrix of a reference, relative to the largest, below which it is not used; by hand."""
_LARGEST_MISFIT = 0.1
"""Root mean square residual of a reference, in diagonals of the images, beyond which it is not used: the cameras that
determine it contradict each other. By hand."""
_FARTHEST = 1.0
"""Root mean square residual of a view, in diagonals of its image, beyond which it is not compared: an image that is
upside down is off by less, and equations linear in the pose of the board say nothing so far off. By hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferenceBoards:
    """Poses of the board that some cameras determine."""

    state: SessionState
    known: Mask
    """(F,) pictures whose pose is known."""
    weight: Floats
    """(F, 6, 6) inverse covariances of the poses, zero where unknown."""
    velocity: Floats
    """(F, 6) rotation [rad] and translation [m] of the board per picture; NaN where unknown."""

    def __post_init__(self) -> None:
        freeze_fields(self, "weight", "velocity")
        freeze_fields(self, "known", dtype=bool)


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferenceViews:
    """The views of one camera as quadratic forms."""

    camera: int
    picture: Integers
    """(V,)."""
    coordinates: Integers
    """(V,) number of coordinates of the corners of each view."""
    square: Floats
    """(V, 19, 19) products of the columns of `CHANGES` and the residual, in standard deviations."""
    alone: Floats
    """(V,) cost of each view if its board may be anywhere."""
    compared: Mask
    """(V,) views whose board other cameras see, not too far from where it was predicted."""

    def __post_init__(self) -> None:
        freeze_fields(self, "square", "alone")
        freeze_fields(self, "picture", "coordinates", dtype=np.int64)
        freeze_fields(self, "compared", dtype=bool)


def reference_boards(solved: SolvedSession, corners: CornerSet, camera: int) -> ReferenceBoards:
    """Place the boards by all cameras but one.

    Args:
        solved: The solved session, whose cameras are used.
        corners: All corners, also those that were left out.
        camera: The camera that takes no part.
    """
    own = np.unique(corners.picture[corners.camera == camera])
    near = np.unique(np.concatenate([own - 1, own, own + 1]))
    others = corners.subset((corners.camera != camera) & np.isin(corners.picture, near))
    count = len(corners.pictures)
    known, weight = np.zeros(count, bool), np.zeros((count, 6, 6))
    state = solved.state
    if len(others):
        problem = session_problem(others, solved.adjusted.problem.board, solved.lens, solved.joined, shape=False)
        fixed = replace(problem, free=np.zeros_like(problem.free))
        found = adjust(fixed, state, rounds=1, displaced=False)
        state, normal = found.state, found.blocks.board
        values = np.linalg.eigvalsh(normal)
        known[np.unique(others.picture)] = True
        known &= values[:, 0] > _LEAST_KNOWN * values[:, -1]
        known &= _misfit(found.residual, others, others.picture, count) < _LARGEST_MISFIT
        weight[known] = normal[known]
    return ReferenceBoards(state=state, known=known, weight=weight, velocity=_velocities(state, known))


def _misfit(residual: Floats, corners: CornerSet, group: Integers, count: int) -> Floats:
    """Return the root mean square residual of groups of corners, in diagonals of the images.

    Args:
        residual: (N, 2) residuals [px]; one that is not finite makes that of its group infinite.
        corners: The corners.
        group: (N,) group of each corner.
        count: Number of groups.
    """
    diagonal = np.linalg.norm(np.array(corners.sizes, float), axis=1)[corners.camera]
    square = np.nan_to_num((residual**2).sum(axis=1) / diagonal**2, nan=np.inf, posinf=np.inf)
    return np.sqrt(np.bincount(group, square, count) / np.maximum(np.bincount(group, minlength=count), 1))


def _velocities(state: SessionState, known: Mask) -> Floats:
    """Return the motion of the board per picture from its neighbours, as left increments of its pose."""
    velocity = np.full((len(known), 6), np.nan)
    inner = np.flatnonzero(known[:-2] & known[2:] & known[1:-1]) + 1
    turn, shift = state.board_rotation, state.board_translation
    velocity[inner, :3] = rotations.log(turn[inner + 1] @ turn[inner - 1].transpose(0, 2, 1)) / 2.0
    velocity[inner, 3:] = (shift[inner + 1] - shift[inner - 1]) / 2.0
    return velocity


def reference_views(
    solved: SolvedSession, corners: CornerSet, camera: int, boards: ReferenceBoards, *, lag: int = 0,
    turned: bool = False,
) -> ReferenceViews:  # fmt: skip
    """Return the views of a camera as quadratic forms.

    Args:
        solved: The solved session.
        corners: All corners, also those that were left out.
        camera: The camera.
        boards: The boards that the other cameras see.
        lag: Number of pictures by which the camera is taken to be late.
        turned: Whether its pictures are taken to be upside down.
    """
    own = corners.subset(corners.camera == camera)
    at = own.picture - lag
    inside = (at >= 0) & (at < len(boards.known))
    own, at = own.subset(inside), at[inside]
    size = np.array(corners.sizes[camera])
    measured = size - 1 - own.pixels if turned else own.pixels
    board = solved.adjusted.problem.board
    # Boards that no other camera sees are those of the solution; they are free.
    places = CornerPlaces(camera=own.camera, pose=at, points=board.points[own.corner], centre=board.centre)
    pixels, slopes = project_corners_with_derivative(boards.state, places)
    white = whitening(own.covariance) / solved.adjusted.unit
    rows = np.zeros((len(own), 2, CHANGES + 1))
    rows[..., :CAMERA] = slopes[..., :CAMERA]
    lens = boards.state.lens[camera]
    rows[..., ZOOM] = lens[0] * slopes[..., 0] + lens[1] * slopes[..., 1]
    motion = np.einsum("nij,nj->ni", slopes[..., BOARD_COLUMNS], np.nan_to_num(boards.velocity[at]))
    rows[..., DELAY] = -motion
    rows[..., READOUT] = motion * ((own.pixels[:, 1:] + 0.5) / size[1] - 0.5)
    rows[..., CHANGES] = measured - pixels
    rows, pose = white @ rows, white @ slopes[..., BOARD_COLUMNS]
    good = np.isfinite(rows).all(axis=(1, 2)) & np.isfinite(pose).all(axis=(1, 2))
    near = _misfit(measured - pixels, own, own.view, len(own.view_starts)) < _FARTHEST
    good &= near[own.view]
    rows[~good], pose[~good] = 0.0, 0.0
    found = _gathered(own, rows, pose, camera, at, boards)
    return replace(found, compared=found.compared & near)


def _gathered(
    own: CornerSet, rows: Floats, pose: Floats, camera: int, at: Integers, boards: ReferenceBoards
) -> ReferenceViews:
    views = len(own.view_starts)
    square, alone = np.zeros((views, CHANGES + 1, CHANGES + 1)), np.zeros(views)
    picture = at[own.view_starts]
    for view in range(views):
        part = own.view_rows(view)
        a, b = rows[part].reshape(-1, CHANGES + 1), pose[part].reshape(-1, 6)
        own_normal, across = b.T @ b, b.T @ a
        weak = 1e-9 * np.trace(own_normal) / 6.0 * np.eye(6) + 1e-12 * np.eye(6)
        inner = np.linalg.solve(own_normal + boards.weight[picture[view]] + weak, across)
        square[view] = a.T @ a - across.T @ inner
        free = np.linalg.solve(own_normal + weak, across[:, CHANGES])
        alone[view] = float(a[:, CHANGES] @ a[:, CHANGES] - across[:, CHANGES] @ free)
    return ReferenceViews(
        camera=camera, picture=own.picture[own.view_starts], coordinates=2 * own.view_counts, square=square,
        alone=alone, compared=boards.known[picture],
    )  # fmt: skip


def lens_prior(state: SessionState, camera: int) -> Floats:
    """Return the weights (15, 15) with which the lens of a camera may differ from the solution.

    Args:
        state: The cameras.
        camera: The camera.
    """
    weight = np.zeros((CAMERA, CAMERA))
    focal = state.lens[camera, 0]
    sd = np.array([0.1 * focal, 0.1 * focal, 0.1 * focal, 0.1 * focal, 0.5, 0.5, 0.01, 0.01, 0.5])
    weight[np.arange(LENS), np.arange(LENS)] = sd**-2.0
    weight[:2, :2] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / (3e-3 * focal) ** 2
    return weight
