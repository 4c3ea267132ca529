"""The whole sequence at once: every pose and the one shape in a single system, banded in time, bordered by the shape.

A pose's observations touch that pose and the shape; smoothness touches three neighbours in time. The
normal equations are block-banded with a border, and are solved as such: the cost grows linearly with
the number of frames ([Plaenkers1999] section 4.1 for the weighting; the structure is ours).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from marey.arrays import Floats, Integers
from marey.body.pose import Pose, PosedBody
from marey.body.skeleton import Skeleton
from marey.body.surface import Body
from marey.fit.body_solver import bounded_step, dense_equations, shape_reach
from marey.fit.levels import FrameLevels
from marey.fit.moments import gather_moments
from marey.fit.normal_equations import normal_equations
from marey.fit.pose_solver import Schedule, add_dense, match_all
from marey.fit.side_by_side import side_by_side
from marey.fit.track import TRUNK
from marey.observations.correspondence import Sighting
from marey.observations.prior import Habit, JointLimits, ShapePrior


@dataclass(frozen=True, kw_only=True)
class SequenceSettings:
    """What is known of motion and shape before looking."""

    limb_acceleration: float = 95.0
    """Standard deviation of a limb's angular acceleration [rad/s2]."""
    trunk_acceleration: float = 47.0
    root_acceleration: float = 12.0
    """Standard deviation of the pelvis' acceleration [m/s2]."""
    habit: float = 0.1
    """How many observations the joints' habits are worth in each frame."""
    gate: tuple[float, float] = (20.0, 5.0)
    scale: tuple[float, float] = (6.0, 2.0)
    sigma_px: float = 3.2
    clip: float = 3.0
    """No shape number goes farther from the prior's mean than so many standard deviations."""


TRUST_M, TRUST_RAD, TRUST_SHAPE = 0.1, 0.2, 0.7
"""How far one round may go where the observations leave it open: Levenberg's and Marquardt's damping [m, rad, sd]."""


@dataclass(frozen=True, eq=False)
class SequenceFit:
    """The refined motion and shape, and what is known of them."""

    frames: Integers
    """(F,) the frames, in order."""
    poses: tuple[Pose, ...]
    body: Body
    """With the shape's numbers and, where they were free, their covariance."""
    covariance: Floats
    """(F, D + M, D + M) of each pose, and of the shape with it where that was free."""
    information: Floats
    """(F, D, D) what each frame's own observations say of its pose."""
    residual_px: float
    """Weighted root mean square of the matches' distances across the contours [px]."""


def acceleration_spread(skeleton: Skeleton, settings: SequenceSettings) -> Floats:
    """Give the standard deviation (D,) of each coordinate's acceleration [m/s2, rad/s2]."""
    turns = [
        settings.trunk_acceleration if c.segment in TRUNK else settings.limb_acceleration for c in skeleton.coordinates
    ]
    return np.array([settings.root_acceleration] * 3 + [settings.trunk_acceleration] * 3 + turns)


@dataclass(eq=False)
class _System:
    """Normal equations of F poses of D coordinates, banded over three neighbours, bordered by M shape numbers."""

    band: Floats
    """(3D, F D) upper form of `scipy.linalg.solveh_banded`."""
    border: Floats
    """(F D, M)."""
    corner: Floats
    """(M, M)."""
    gradient: Floats
    """(F D,)."""
    shape_gradient: Floats
    """(M,)."""

    @staticmethod
    def empty(frames: int, degrees: int, numbers: int) -> "_System":
        size = frames * degrees
        return _System(
            np.zeros((3 * degrees, size)), np.zeros((size, numbers)), np.zeros((numbers, numbers)),
            np.zeros(size), np.zeros(numbers),
        )  # fmt: skip

    def add_block(self, row: int, column: int, block: Floats) -> None:
        """Add a block (D, D) of the upper triangle; the lower half of a diagonal block is left out."""
        degrees = len(block)
        last = len(self.band) - 1
        i, j = np.meshgrid(np.arange(degrees), np.arange(degrees), indexing="ij")
        r, c = row * degrees + i, column * degrees + j
        upper = c >= r
        self.band[(last + r - c)[upper], c[upper]] += block[upper]

    def add_frame(self, f: int, hessian: Floats, gradient: Floats, degrees: int) -> None:
        """Add the equations of one frame, with or without the shape."""
        here = slice(f * degrees, (f + 1) * degrees)
        self.add_block(f, f, hessian[:degrees, :degrees])
        self.gradient[here] += gradient[:degrees]
        if len(gradient) > degrees:
            self.border[here] += hessian[:degrees, degrees:]
            self.corner += hessian[degrees:, degrees:]
            self.shape_gradient += gradient[degrees:]

    def add_smoothness(self, f: int, poses: Sequence[Pose], spread: Floats) -> None:
        """Draw the change from f-1 to f and that from f to f+1 together: their difference is an acceleration."""
        degrees = len(spread)
        residual = poses[f].change_to(poses[f + 1]) - poses[f - 1].change_to(poses[f])
        weight = 1.0 / spread**2
        share = {f - 1: 1.0, f: -2.0, f + 1: 1.0}
        for a, wa in share.items():
            self.gradient[a * degrees : (a + 1) * degrees] += wa * weight * residual
            for b, wb in share.items():
                if b >= a:
                    self._add_diagonal(a, b, wa * wb * weight)

    def _add_diagonal(self, row: int, column: int, values: Floats) -> None:
        degrees = len(values)
        offset = (column - row) * degrees
        columns = np.arange(column * degrees, (column + 1) * degrees)
        self.band[len(self.band) - 1 - offset, columns] += values

    def solve(self, trust: Floats, shape_trust: float, reach: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Solve by eliminating the poses: give their step (F D,) and the shape's (M,).

        Args:
            trust: (D,) how far a coordinate is believed to lie from where it stands; it damps what nothing fixes.
            shape_trust: the same for the shape's numbers.
            reach: (M,) least and greatest step of the shape's numbers; the poses' steps suit the step that is taken.
        """
        band = self.band.copy()
        band[-1] += np.tile(1.0 / trust**2, band.shape[1] // len(trust))
        corner = self.corner + np.eye(len(self.corner)) / shape_trust**2
        factor = scipy.linalg.cholesky_banded(band, check_finite=False)
        right = np.concatenate([self.gradient[:, None], self.border], 1)
        solved = scipy.linalg.cho_solve_banded((factor, False), right, check_finite=False)
        if len(self.corner) == 0:
            return -solved[:, 0], np.zeros(0)
        information = corner - self.border.T @ solved[:, 1:]
        shape = bounded_step(information, self.shape_gradient - self.border.T @ solved[:, 0], *reach)
        return -(solved[:, 0] + solved[:, 1:] @ shape), shape


def refine_sequence(
    frames: Sequence[int],
    poses: Sequence[Pose],
    body: Body,
    levels: FrameLevels,
    *,
    rate: float,
    rounds: int,
    shape_frames: Sequence[int] = (),
    settings: SequenceSettings | None = None,
    done: Callable[[int], None] = lambda frame: None,
) -> SequenceFit:
    """Refine all poses, and the shape where frames for it are named, in one system.

    Args:
        frames: (F,) in order; smoothness holds between frames whose numbers follow each other.
        poses: one a frame.
        body: the person; its shape numbers are free when `shape_frames` are named.
        levels: silhouettes.
        rate: frames in a second.
        rounds: how often correspondence and solution follow each other.
        shape_frames: frames whose outlines also speak of the shape.
        settings: what is known before.
        done: told of every frame in every round.
    """
    settings = settings or SequenceSettings()
    schedule = Schedule(
        iterations=max(rounds, 2), gate=settings.gate, scale=settings.scale, cosine=0.5, sigma_px=settings.sigma_px,
        interior=True,
    )  # fmt: skip
    spread = acceleration_spread(body.skeleton, settings) / rate**2
    poses = list(poses)
    free = set(shape_frames)
    fit = None
    for round_ in range(rounds):
        system, information, residual = _assemble(frames, poses, body, levels, free, schedule, round_, settings, done)
        for f in range(1, len(frames) - 1):
            if frames[f + 1] - frames[f - 1] == 2:
                system.add_smoothness(f, poses, spread)
        degrees = len(spread)
        trust = np.array([TRUST_M] * 3 + [TRUST_RAD] * (degrees - 3))
        step, shape = system.solve(trust, TRUST_SHAPE, shape_reach(body, settings.clip))
        poses = [p.step(s) for p, s in zip(poses, step.reshape(-1, degrees), strict=True)]
        if free:
            body = body.with_numbers(body.numbers + shape)
        if round_ == rounds - 1:
            covariance = _covariances(system, degrees)
            body = replace(body, numbers_covariance=covariance[0, degrees:, degrees:]) if free else body
            fit = SequenceFit(np.array(frames), tuple(poses), body, covariance, information, residual)
    if fit is None:
        raise ValueError("at least one round is needed")
    return fit


def _assemble(
    frames: Sequence[int],
    poses: Sequence[Pose],
    body: Body,
    levels: FrameLevels,
    free: set[int],
    schedule: Schedule,
    round_: int,
    settings: SequenceSettings,
    done: Callable[[int], None],
) -> tuple[_System, Floats, float]:
    degrees = len(body.skeleton)
    system = _System.empty(len(frames), degrees, len(body.space) if free else 0)
    information = np.zeros((len(frames), degrees, degrees))
    squares = total = 0.0
    matching, scale = schedule.at(round_)
    priors = (JointLimits(), Habit(share=settings.habit))

    def equations(f: int, sightings: Sequence[Sighting]) -> tuple[Floats, Floats, float, float]:
        posed = PosedBody(body, poses[f])
        found, weights = match_all(posed, sightings, matching, scale)
        if frames[f] in free:
            hessian, gradient, _ = dense_equations(posed, found, weights, priors)
        else:
            hessian, gradient, _ = normal_equations(posed, gather_moments(posed, found, weights))
            add_dense(posed, priors, hessian, gradient)
        across = [float(w @ (m.residuals(posed) ** 2).sum(1)) for w, m in zip(weights, found, strict=True)]
        return hessian, gradient, sum(across), sum(float(w.sum()) for w in weights)

    # The silhouettes are read here, one frame after the other; only what is computed from them runs side by side.
    tasks = ((f, levels.at(frame).sightings) for f, frame in enumerate(frames))
    for f, (hessian, gradient, across, weight) in enumerate(side_by_side(lambda task: equations(*task), tasks)):
        squares += across
        total += weight
        information[f] = hessian[:degrees, :degrees]
        system.add_frame(f, hessian, gradient, degrees)
        done(frames[f])
    if free:
        white = ShapePrior().whiten(PosedBody(body, poses[0]), shape=True)
        jacobian = white.jacobian[:, degrees:]
        system.corner += jacobian.T @ jacobian
        system.shape_gradient += jacobian.T @ white.residual
    return system, information, float(np.sqrt(squares / total)) if total else float("nan")


def _covariances(system: _System, degrees: int) -> Floats:
    """Give the diagonal blocks (F, D + M, D + M) of the system's inverse, by the recursion of the banded factor.

    Ours: the poses' inverse is needed near its diagonal only, where it follows backwards from the
    Cholesky factor ([Takahashi1973]); the shape's share comes on top.
    """
    count = len(system.gradient) // degrees
    band = system.band.copy()
    band[-1] += 1e-12 * band[-1].max()
    factor = scipy.linalg.cholesky_banded(band, check_finite=False)
    blocks = _inverse_blocks(factor, count, degrees)
    numbers = len(system.corner)
    covariance = np.zeros((count, degrees + numbers, degrees + numbers))
    covariance[:, :degrees, :degrees] = blocks
    if numbers:
        solved = scipy.linalg.cho_solve_banded((factor, False), system.border, check_finite=False)
        shape = np.linalg.inv(system.corner - system.border.T @ solved)
        spread = solved.reshape(count, degrees, numbers)
        covariance[:, :degrees, :degrees] += spread @ shape @ np.swapaxes(spread, 1, 2)
        covariance[:, :degrees, degrees:] = -spread @ shape
        covariance[:, degrees:, :degrees] = np.swapaxes(covariance[:, :degrees, degrees:], 1, 2)
        covariance[:, degrees:, degrees:] = shape
    return covariance


def _inverse_blocks(factor: Floats, count: int, degrees: int) -> Floats:
    """Give the diagonal blocks of (U'U)^-1 for a banded factor U of two blocks beside the diagonal."""

    def upper(row: int, column: int) -> Floats:
        block = np.zeros((degrees, degrees))
        if column >= count:
            return block
        i, j = np.meshgrid(np.arange(degrees), np.arange(degrees), indexing="ij")
        r, c = row * degrees + i, column * degrees + j
        inside = (c >= r) & (c - r < len(factor))
        block[inside] = factor[(len(factor) - 1 + r - c)[inside], c[inside]]
        return block

    inverse: dict[tuple[int, int], Floats] = {}
    zero = np.zeros((degrees, degrees))
    for f in range(count - 1, -1, -1):
        diagonal = upper(f, f)
        own = scipy.linalg.solve_triangular(diagonal, np.eye(degrees), check_finite=False)
        first, second = own @ upper(f, f + 1), own @ upper(f, f + 2)
        near, far, beyond = (
            inverse.get((f + 1, f + 1), zero), inverse.get((f + 2, f + 2), zero), inverse.get((f + 1, f + 2), zero)
        )  # fmt: skip
        inverse[f, f + 1] = -(first @ near + second @ beyond.T)
        inverse[f, f + 2] = -(first @ beyond + second @ far)
        # A sum of squares, so that rounding cannot make a variance negative.
        cross = first @ beyond @ second.T
        whole = own @ own.T + first @ near @ first.T + second @ far @ second.T + cross + cross.T
        inverse[f, f] = 0.5 * (whole + whole.T)
    return np.array([inverse[f, f] for f in range(count)])
