"""Joint adjustment of cameras, lenses, board poses and board shape, robust against wrong corners.

A Levenberg-Marquardt iteration minimises the sum of Huber's function of the corners' distances, each divided by its
standard deviations. The unit of these standard deviations, and a factor for each picture, are estimated from
the residuals.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.equations import NormalBlocks, ViewPlaces, assemble, view_places
from marey.calibration.adjustment.projection import (
    COLUMNS,
    CornerPlaces,
    project_corners,
    project_corners_with_derivative,
)
from marey.calibration.adjustment.state import CAMERA, LENS, SHAPE, SessionState
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet

_HUBER = 2.5
"""Distance from which the weight of a corner falls, in standard deviations in two dimensions; chosen by hand."""
_LOST = 1e3
"""Distance that stands for a corner behind a camera, in standard deviations; chosen by hand."""
_MEDIAN_LENGTH = 1.1774
"""Median length of a normal deviation in two dimensions with unit standard deviations: sqrt(2 ln 2)."""
_FIRST_DAMPING = 1e-4
"""First damping, as a share of the diagonal; chosen by hand."""
_GREATEST_DAMPING = 1e8
"""Damping at which the iteration ends without a better step; chosen by hand."""
_VIEW_STRENGTH = 20.0
"""Strength of the common noise against that of a single view, in coordinates; chosen by hand."""
_NOISE_ROUNDS = 5
"""Number of times that the factors of the views and the common unit are estimated in turn; chosen by hand."""
_CAPPED = 1.0 - np.exp(-0.5 * _HUBER**2)
"""Mean square of normal deviations in two dimensions that are capped at Huber's distance, as a share of two."""
_LEAST_UNIT = 1e-6
"""Smallest estimated unit of the corners' standard deviations, so that exact corners can be adjusted."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AdjustmentProblem:
    """Corners with standard deviations, and what is known about the unknowns beforehand."""

    corners: CornerSet
    board: CalibrationBoard
    pose: Integers
    """(F,) board pose of each picture; still pictures share one."""
    free: Mask
    """(15 C + 4,) common unknowns that are estimated."""
    prior_mean: Floats
    """(15 C + 4,) expected values of the lenses and the shape; not used for camera poses."""
    prior_sd: Floats
    """(15 C + 4,) their standard deviations, infinite where nothing is known."""
    fixed_pose: Mask
    """(B,) board poses that do not change."""

    @property
    def places(self) -> CornerPlaces:
        """Camera, board pose and corner of each observation."""
        return CornerPlaces(
            camera=self.corners.camera, pose=self.pose[self.corners.picture],
            points=self.board.points[self.corners.corner], centre=self.board.centre,
        )  # fmt: skip

    @property
    def views(self) -> ViewPlaces:
        """The corners by view."""
        return view_places(self.corners.view, self.corners.camera, self.pose[self.corners.picture])


@dataclass(frozen=True, eq=False, kw_only=True)
class Adjusted:
    """The adjusted unknowns and the corners' residuals."""

    problem: AdjustmentProblem
    state: SessionState
    residual: Floats
    """(N, 2) measured minus predicted pixels [px]; NaN behind a camera."""
    unit: float
    """Factor by which the stated standard deviations of all corners were multiplied."""
    view_factor: Floats
    """(V,) further factor of each view."""
    blocks: NormalBlocks = field(repr=False)
    """Normal equations at the solution, with the estimated standard deviations and the priors."""
    rows: Floats = field(repr=False)
    """(N, 2, 26) weighted derivatives and residuals at the solution."""

    @property
    def distance(self) -> Floats:
        """(N,) length of each residual in its standard deviations."""
        corners = self.problem.corners
        scale = self.unit * self.view_factor[corners.view]
        whitened = np.einsum("nij,nj->ni", whitening(corners.covariance), self.residual)
        return np.asarray(np.linalg.norm(whitened, axis=1) / scale)


def whitening(covariance: Floats) -> Floats:
    """Return matrices W (n, 2, 2) with W^T W the inverse of covariances (n, 2, 2)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def adjust(problem: AdjustmentProblem, state: SessionState, *, rounds: int = 4, iterations: int = 30) -> Adjusted:
    """Adjust all unknowns.

    Args:
        problem: The corners.
        state: Start values.
        rounds: Number of times that the corners' standard deviations are estimated.
        iterations: Largest number of steps in each round.

    Returns:
        The solution.
    """
    white, factor = whitening(problem.corners.covariance), np.ones(len(problem.corners.view_starts))
    places, views = problem.places, problem.views
    unit = _robust_unit(_whitened(problem, state, places, white))
    for _ in range(rounds):
        scaled = white / (unit * factor[problem.corners.view])[:, None, None]
        state = _minimise(problem, state, places, views, scaled, iterations)
        residual = _whitened(problem, state, places, white)
        before, (unit, factor) = unit, _noise(problem, residual, _robust_unit(residual))
        if abs(unit / before - 1.0) < 1e-4:
            break
    scaled = white / (unit * factor[problem.corners.view])[:, None, None]
    state = _minimise(problem, state, places, views, scaled, iterations)
    rows = _weighted_rows(problem, state, places, scaled)
    blocks = _with_priors(problem, state, _blocks(problem, state, views, rows))
    residual = problem.corners.pixels - project_corners(state, places)[0]
    return Adjusted(
        problem=problem, state=state, residual=residual, unit=unit, view_factor=factor, blocks=blocks, rows=rows
    )  # fmt: skip


def _whitened(problem: AdjustmentProblem, state: SessionState, places: CornerPlaces, white: Floats) -> Floats:
    """Return residuals (N, 2) in units of the stated standard deviations."""
    residual = problem.corners.pixels - project_corners(state, places)[0]
    return np.asarray(np.einsum("nij,nj->ni", white, residual))


def _robust_unit(whitened: Floats) -> float:
    length = np.linalg.norm(whitened, axis=1)
    return max(float(np.nanmedian(length)) / _MEDIAN_LENGTH, _LEAST_UNIT)


def _noise(problem: AdjustmentProblem, whitened: Floats, unit: float) -> tuple[float, Floats]:
    """Estimate the common unit and the factors (V,) of the views from whitened residuals (N, 2)."""
    corners = problem.corners
    redundancy = 2.0 * _redundancy(problem) * corners.view_counts
    factor = np.ones(len(corners.view_starts))
    for _ in range(_NOISE_ROUNDS):
        length = np.linalg.norm(whitened, axis=1) / (unit * factor[corners.view])
        square = np.minimum(np.where(np.isnan(length), _LOST, length), _HUBER) ** 2 / _CAPPED
        sums = np.bincount(corners.view, square, minlength=len(factor))
        unit = max(unit * float(np.sqrt(sums.sum() / redundancy.sum())), _LEAST_UNIT)
        factor = np.sqrt((_VIEW_STRENGTH + sums * factor**2) / (_VIEW_STRENGTH + redundancy))
    return unit, factor


def _redundancy(problem: AdjustmentProblem) -> float:
    """Return the share of the coordinates that exceeds the unknowns, at least a tenth."""
    poses = len(np.unique(problem.pose[problem.corners.picture])) - int(problem.fixed_pose.sum())
    unknowns = int(problem.free.sum()) + 6 * poses
    return max(1.0 - unknowns / max(2.0 * len(problem.corners), 1.0), 0.1)


def _weighted_rows(problem: AdjustmentProblem, state: SessionState, places: CornerPlaces, white: Floats) -> Floats:
    """Return weighted derivatives and residuals (N, 2, 26); zero for corners behind a camera."""
    pixels, slopes = project_corners_with_derivative(state, places)
    rows = np.empty((len(pixels), 2, COLUMNS + 1))
    rows[..., :COLUMNS], rows[..., COLUMNS] = slopes, problem.corners.pixels - pixels
    rows = white @ rows
    length = np.linalg.norm(rows[..., COLUMNS], axis=1)
    weight = np.where(length > _HUBER, _HUBER / np.where(length > 0, length, 1.0), 1.0)
    rows *= np.sqrt(weight)[:, None, None]
    rows[~np.isfinite(rows).all(axis=(1, 2))] = 0.0
    return rows


def _cost(problem: AdjustmentProblem, state: SessionState, places: CornerPlaces, white: Floats) -> float:
    length = np.linalg.norm(_whitened(problem, state, places, white), axis=1)
    length = np.where(np.isnan(length), _LOST, length)
    robust = np.where(length < _HUBER, length**2, _HUBER * (2 * length - _HUBER))
    deviation = (_common_values(state) - problem.prior_mean) / problem.prior_sd
    return float(robust.sum() + np.square(deviation).sum())


def _common_values(state: SessionState) -> Floats:
    """Return the common unknowns (D,); those of the camera poses are zero, since nothing is known of them."""
    values = np.zeros((state.cameras, CAMERA))
    values[:, :LENS] = state.lens
    return np.concatenate([values.ravel(), state.shape])


def _blocks(problem: AdjustmentProblem, state: SessionState, views: ViewPlaces, rows: Floats) -> NormalBlocks:
    return assemble(rows, views, cameras=state.cameras, poses=state.poses, fixed=problem.fixed_pose)


def _with_priors(problem: AdjustmentProblem, state: SessionState, blocks: NormalBlocks) -> NormalBlocks:
    weight = problem.prior_sd**-2.0
    right = weight * (problem.prior_mean - _common_values(state))
    return replace(blocks, common=blocks.common + np.diag(weight), common_right=blocks.common_right + right)


def _step(problem: AdjustmentProblem, blocks: NormalBlocks, damping: float) -> tuple[Floats, Floats]:
    damped = blocks.damped(damping)
    matrix, right = damped.reduced()
    free, step = problem.free, np.zeros(len(right))
    size = np.sqrt(np.maximum(np.diag(matrix)[free], 1e-300))
    scaled = matrix[np.ix_(free, free)] / size[:, None] / size
    step[free] = np.linalg.lstsq(scaled, right[free] / size, rcond=1e-14)[0] / size
    return step, damped.board_steps(step)


def _minimise(
    problem: AdjustmentProblem, state: SessionState, places: CornerPlaces, views: ViewPlaces, white: Floats, most: int
) -> SessionState:
    """Iterate with Levenberg-Marquardt steps until the cost no longer falls."""
    cost, damping = _cost(problem, state, places, white), _FIRST_DAMPING
    for _ in range(most):
        rows = _weighted_rows(problem, state, places, white)
        blocks = _with_priors(problem, state, _blocks(problem, state, views, rows))
        while damping < _GREATEST_DAMPING:
            try:
                trial = state.stepped(*_step(problem, blocks, damping))
            except np.linalg.LinAlgError:
                damping *= 10.0
                continue
            new = _cost(problem, trial, places, white)
            if new < cost:
                break
            damping *= 10.0
        else:
            return state
        gain, cost, state, damping = cost - new, new, trial, max(damping / 10.0, 1e-12)
        if gain < 1e-7 * cost:
            break
    return state


def free_unknowns(cameras: int, *, lens: Mask, first_pose: bool, shape: bool) -> Mask:
    """Return which common unknowns are estimated.

    Args:
        cameras: Number of cameras C.
        lens: (C, 9) lens parameters that are estimated.
        first_pose: Whether the pose of the first camera is estimated.
        shape: Whether the board's shape is.

    Returns:
        (15 C + 4,).
    """
    own = np.ones((cameras, CAMERA), bool)
    own[:, :LENS] = lens
    own[0, LENS:] = first_pose
    return np.concatenate([own.ravel(), np.full(SHAPE, shape)])
