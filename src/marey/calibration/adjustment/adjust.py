"""Joint adjustment of cameras, lenses, board poses and board shape, robust against wrong corners.

A Levenberg-Marquardt iteration minimises the sum of Huber's function of the corners' distances, each divided by its
standard deviations. The unit of these standard deviations, and a factor for each picture, are estimated from
the residuals.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.displacement import estimate_displacement
from marey.calibration.adjustment.equations import (
    HUBER,
    NormalBlocks,
    ViewPlaces,
    ViewSystems,
    assemble,
    view_places,
    view_systems,
)
from marey.calibration.adjustment.projection import (
    BOARD_COLUMNS,
    COLUMNS,
    LATE_COLUMN,
    RESIDUAL_COLUMN,
    CornerPlaces,
    project_corners,
    project_corners_with_derivative,
)
from marey.calibration.adjustment.state import CAMERA, LENS, SHAPE, SessionState
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationTarget, CalibrationWand

_MEDIAN_LENGTH = 1.1774
"""Median length of a normal deviation in two dimensions with unit standard deviations: sqrt(2 ln 2)."""
_FIRST_DAMPING = 1e-4
"""First damping, as a share of the diagonal; chosen by hand."""
_GREATEST_DAMPING = 1e8
"""Damping at which the iteration ends without a better step; chosen by hand."""
_SETTLED = 1e-3
"""Relative change of the noise that ends the rounds; chosen by hand."""
_LEAST_GAIN = 1e-7
"""Relative gain of the cost that ends the iteration; chosen by hand."""
_VIEW_STRENGTH = 20.0
"""Strength of the common noise against that of a single view, in coordinates; chosen by hand."""
_NOISE_ROUNDS = 5
"""Number of times that the factors of the views and the common unit are estimated in turn; chosen by hand."""
_CAPPED = 1.0 - np.exp(-0.5 * HUBER**2)
"""Mean square of normal deviations in two dimensions that are capped at Huber's distance, as a share of two."""
_LEAST_UNIT = 1e-2
"""Smallest estimated unit of the corners' standard deviations, so that exact corners can be adjusted."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AdjustmentProblem:
    """Corners with standard deviations, and what is known about the unknowns beforehand."""

    corners: CornerSet
    """Points of the board; those with the number behind its last point are landmarks, each with a pose of its own."""
    board: CalibrationTarget
    pose: Integers
    """(F,) board pose of each picture; still pictures share one."""
    free: Mask
    """(16 C + 4,) common unknowns that are estimated."""
    prior_mean: Floats
    """(16 C + 4,) expected values of the lenses, the shape and the delays; not used for camera poses."""
    prior_sd: Floats
    """(16 C + 4,) their standard deviations, infinite where nothing is known."""
    aspect_sd: Floats
    """(C,) standard deviations of the differences of the two focal lengths [px]."""
    fixed_pose: Mask
    """(B,) board poses that do not change."""
    place_mean: Floats
    """(B, 3) expected translations of the board poses; not used where nothing is known [m]."""
    place_sd: Floats
    """(B,) their standard deviations [m]: infinite for boards, those of the given coordinates for landmarks."""
    omitted: Floats
    """(C, 9, 9) expected products of distortion coefficients that are taken as zero, since the corners do not support
    them; zero for all other parameters of the lenses."""

    @property
    def motion(self) -> Floats:
        """(N, 2) change of each corner if its camera is later by one picture [px]."""
        motion = self.corners.motion
        return np.zeros_like(self.corners.pixels) if motion is None else motion

    def measured(self, state: SessionState) -> Floats:
        """Return where the corners are (N, 2) if the cameras are late as in a state [px]."""
        return np.asarray(self.corners.pixels + self.motion * state.delay[self.corners.camera][:, None])

    @property
    def landmark_pose(self) -> Mask:
        """(B,) poses that stand for a landmark."""
        return np.isfinite(self.place_sd)

    @property
    def unknowns(self) -> int:
        """Number of unknowns that the corners determine; the rotation of a wand about its stick is none."""
        seen = np.unique(self.pose[self.corners.picture])
        own = seen[~self.fixed_pose[seen] & ~self.landmark_pose[seen]]
        each = 5 if isinstance(self.board, CalibrationWand) else 6
        return int(self.free.sum()) + each * len(own)

    @property
    def places(self) -> CornerPlaces:
        """Camera, board pose and corner of each observation."""
        return CornerPlaces(
            camera=self.corners.camera, pose=self.pose[self.corners.picture],
            points=corner_points(self.board, self.corners.corner), centre=self.board.centre,
        )  # fmt: skip

    @property
    def views(self) -> ViewPlaces:
        """The corners by view."""
        pose = self.pose[self.corners.picture]
        found = view_places(self.corners.view, self.corners.camera, pose)
        return replace(found, loose=~self.landmark_pose[found.pose])


def corner_points(board: CalibrationTarget, corner: Integers) -> Floats:
    """Return the places of corners on a board; a landmark is a board's centre, which no stretch or bend moves.

    Args:
        board: The board.
        corner: (N,) numbers; that behind the last point stands for a landmark.

    Returns:
        (N, 3) [m].
    """
    return np.asarray(np.concatenate([board.points, board.centre[None]])[corner])


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
    spread: tuple[float, float]
    """Standard deviations of rotation [rad] and translation [m] by which the boards of a picture's views differ."""
    blocks: NormalBlocks = field(repr=False)
    """Normal equations at the solution, with the estimated standard deviations and the priors."""
    systems: ViewSystems = field(repr=False)
    """Contributions of the views at the solution."""

    @property
    def distance(self) -> Floats:
        """(N,) length of each residual in its standard deviations, without the displacement of its view's board."""
        return np.asarray(np.linalg.norm(self.systems.own, axis=1))


def whitening(covariance: Floats) -> Floats:
    """Return matrices W (n, 2, 2) with W^T W the inverse of covariances (n, 2, 2)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def adjust(
    problem: AdjustmentProblem, state: SessionState, *, rounds: int = 4, iterations: int = 30, displaced: bool = True
) -> Adjusted:
    """Adjust all unknowns.

    Args:
        problem: The corners.
        state: Start values.
        rounds: Number of times that the corners' standard deviations are estimated.
        iterations: Largest number of steps in each round.
        displaced: Whether the boards of a picture's views may differ by displacements, estimated from their corners.

    Returns:
        The solution.
    """
    work = _Work(problem)
    noise = _Noise(work.robust_unit(state), np.ones(len(problem.corners.view_starts)), (0.0, 0.0))
    for _ in range(rounds):
        state, _ = work.minimise(state, noise, iterations)
        before, noise = noise.unit, work.estimated_noise(state, noise, displaced=displaced)
        if abs(noise.unit / before - 1.0) < _SETTLED:
            break
    state, systems = work.minimise(state, noise, iterations)
    residual = problem.measured(state) - project_corners(state, work.places)[0]
    return Adjusted(
        problem=problem, state=state, residual=residual, unit=noise.unit, view_factor=noise.factor,
        spread=noise.spread, blocks=work.blocks(state, systems), systems=systems,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Noise:
    """Standard deviations of corners and boards."""

    unit: float
    factor: Floats
    """(V,)."""
    spread: tuple[float, float]


class _Work:
    """The iteration: what does not change while it runs, and its steps."""

    def __init__(self, problem: AdjustmentProblem):
        self.problem, self.places, self.views = problem, problem.places, problem.views
        self.white = whitening(problem.corners.covariance)

    def robust_unit(self, state: SessionState) -> float:
        residual = self.problem.measured(state) - project_corners(state, self.places)[0]
        length = np.linalg.norm(np.einsum("nij,nj->ni", self.white, residual), axis=1)
        return max(float(np.nanmedian(length)) / _MEDIAN_LENGTH, _LEAST_UNIT)

    def systems(self, state: SessionState, noise: _Noise) -> ViewSystems:
        pixels, slopes = project_corners_with_derivative(state, self.places)
        rows = np.empty((len(pixels), 2, RESIDUAL_COLUMN + 1))
        rows[..., :COLUMNS], rows[..., LATE_COLUMN] = slopes, -self.problem.motion
        rows[..., RESIDUAL_COLUMN] = self.problem.measured(state) - pixels
        # A landmark is a point: it has no rotation.
        landmark = self.problem.landmark_pose[self.places.pose]
        rows[landmark, :, BOARD_COLUMNS.start : BOARD_COLUMNS.start + 3] = 0.0
        scale = noise.unit * noise.factor[self.problem.corners.view]
        rows = (self.white / scale[:, None, None]) @ rows
        return view_systems(rows, self.views, self.arm(state), noise.spread)

    def arm(self, state: SessionState) -> Floats:
        return np.asarray(state.board_rotation[self.views.pose] @ self.problem.board.centre)

    def cost(self, state: SessionState, systems: ViewSystems) -> float:
        deviation = (_common_values(state) - self.problem.prior_mean) / self.problem.prior_sd
        aspect = (state.lens[:, 0] - state.lens[:, 1]) / self.problem.aspect_sd
        place = (state.board_translation - self.problem.place_mean) / self.problem.place_sd[:, None]
        return systems.cost + float(np.square(deviation).sum() + np.square(aspect).sum() + np.square(place).sum())

    def blocks(self, state: SessionState, systems: ViewSystems) -> NormalBlocks:
        problem = self.problem
        blocks = assemble(
            systems.square, self.views, cameras=state.cameras, poses=state.poses, fixed=problem.fixed_pose
        )  # fmt: skip
        weight = np.diag(problem.prior_sd**-2.0)
        right = np.diag(weight) * (problem.prior_mean - _common_values(state))
        for camera, sd in enumerate(problem.aspect_sd):
            focal = slice(CAMERA * camera, CAMERA * camera + 2)
            weight[focal, focal] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / sd**2
            right[focal] += np.array([-1.0, 1.0]) * (state.lens[camera, 0] - state.lens[camera, 1]) / sd**2
        board, board_right = blocks.board.copy(), blocks.board_right.copy()
        place = problem.place_sd[:, None] ** -2.0
        board[:, 3:, 3:] += place[:, :, None] * np.eye(3)
        board_right[:, 3:] += place * (problem.place_mean - state.board_translation)
        return replace(
            blocks, common=blocks.common + weight, common_right=blocks.common_right + right, board=board,
            board_right=board_right,
        )  # fmt: skip

    def minimise(self, state: SessionState, noise: _Noise, most: int) -> tuple[SessionState, ViewSystems]:
        """Iterate with Levenberg-Marquardt steps until the cost no longer falls."""
        systems, damping = self.systems(state, noise), _FIRST_DAMPING
        cost = self.cost(state, systems)
        for _ in range(most):
            blocks = self.blocks(state, systems)
            better = None
            while better is None and damping < _GREATEST_DAMPING:
                better = self._try(state, blocks, noise, damping, cost)
                damping = damping / 10.0 if better is not None else damping * 10.0
            if better is None:
                break
            damping = max(damping, 1e-12)
            before, (state, systems, cost) = cost, better
            if before - cost < _LEAST_GAIN * before:
                break
        return state, systems

    def _try(
        self, state: SessionState, blocks: NormalBlocks, noise: _Noise, damping: float, cost: float
    ) -> tuple[SessionState, ViewSystems, float] | None:
        try:
            trial = state.stepped(*_step(self.problem, blocks, damping))
        except np.linalg.LinAlgError:
            return None
        systems = self.systems(trial, noise)
        new = self.cost(trial, systems)
        return (trial, systems, new) if new < cost else None

    def estimated_noise(self, state: SessionState, noise: _Noise, *, displaced: bool) -> _Noise:
        """Estimate the standard deviations from the residuals."""
        systems = self.systems(state, noise)
        scale = noise.unit * noise.factor[self.problem.corners.view]
        length = np.linalg.norm(systems.own, axis=1) * scale
        unit, factor = self._corner_noise(length, noise)
        if not displaced:
            return _Noise(unit, factor, (0.0, 0.0))
        fresh = self.systems(state, _Noise(unit, factor, (0.0, 0.0)))
        return _Noise(unit, factor, self._displacement(fresh, state))

    def _displacement(self, systems: ViewSystems, state: SessionState) -> tuple[float, float]:
        own = self.views.loose
        return estimate_displacement(systems.square[own], self.views.pose[own], self.arm(state)[own])

    def _corner_noise(self, length: Floats, noise: _Noise) -> tuple[float, Floats]:
        """Estimate the common unit and the factors (V,) of the views from whitened lengths (N,)."""
        corners = self.problem.corners
        redundancy = 2.0 * self._redundancy(loose=max(noise.spread) > 0) * corners.view_counts
        unit, factor = noise.unit, np.ones(len(corners.view_starts))
        for _ in range(_NOISE_ROUNDS):
            square = np.minimum(length / (unit * factor[corners.view]), HUBER) ** 2 / _CAPPED
            sums = np.bincount(corners.view, square, minlength=len(factor))
            unit = max(unit * float(np.sqrt(sums.sum() / redundancy.sum())), _LEAST_UNIT)
            factor = np.sqrt((_VIEW_STRENGTH + sums * factor**2) / (_VIEW_STRENGTH + redundancy))
        return unit, factor

    def _redundancy(self, *, loose: bool) -> float:
        """Return the share of the coordinates that exceeds the unknowns, at least 10 %."""
        problem = self.problem
        unknowns = int(problem.free.sum()) + 6 * len(self.views.pose) if loose else problem.unknowns
        return max(1.0 - unknowns / max(2.0 * len(problem.corners), 1.0), 0.1)


def _common_values(state: SessionState) -> Floats:
    """Return the common unknowns (D,); those of the camera poses are zero, since nothing is known of them."""
    values = np.zeros((state.cameras, CAMERA))
    values[:, :LENS] = state.lens
    return np.concatenate([values.ravel(), state.shape, state.delay])


def _step(problem: AdjustmentProblem, blocks: NormalBlocks, damping: float) -> tuple[Floats, Floats]:
    damped = blocks.damped(damping)
    matrix, right = damped.reduced()
    free, step = problem.free, np.zeros(len(right))
    size = np.sqrt(np.maximum(np.diag(matrix)[free], 1e-300))
    scaled = matrix[np.ix_(free, free)] / size[:, None] / size
    step[free] = np.linalg.solve(scaled, right[free] / size) / size
    return step, damped.board_steps(step)


def free_unknowns(
    cameras: int, *, lens: Mask, first_pose: bool, shape: bool, delay: Mask | None = None
) -> Mask:
    """Return which common unknowns are estimated.

    Args:
        cameras: Number of cameras C.
        lens: (C, 9) lens parameters that are estimated.
        first_pose: Whether the pose of the first camera is estimated.
        shape: Whether the board's shape is.
        delay: (C,) cameras whose delays are; by default none.

    Returns:
        (16 C + 4,).
    """
    own = np.ones((cameras, CAMERA), bool)
    own[:, :LENS] = lens
    own[0, LENS:] = first_pose
    return np.concatenate([own.ravel(), np.full(SHAPE, shape), np.zeros(cameras, bool) if delay is None else delay])
