"""Joint solution for motion and shapes of the perspective model, and random draws from their joint uncertainty.

Solved in turns, motion and shapes converge slowly where they can follow each other, and each takes the other as exact:
a covariance of the frames alone is too small by a factor of up to forty. Here the equations of both are solved together
by conjugate gradients, preconditioned by the blocks of either half.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.linalg

from marey.arrays import Floats
from marey.geometry import rotations
from marey.geometry.vectors import products
from marey.nonrigid.core.rotation_paths import acceleration_jacobians
from marey.nonrigid.one_camera.perspective_model import (
    MOTION,
    PerspectiveModel,
    basis_equations,
    distance_jacobians,
    frame_equations,
    image_residuals,
    lengths_of,
    negative_log_probability,
    residuals_and_jacobians,
    set_gauge,
    solve_frames,
    solve_shapes,
    solve_variances,
)
from marey.nonrigid.one_camera.perspective_starts import PerspectiveStart
from marey.nonrigid.one_camera.shape_equations import ShapeEquations, in_rows, in_shapes

_TOLERANCE = 1e-3
"""Conjugate gradient steps end when the preconditioned residual falls below this fraction of the right-hand side."""


@dataclass(frozen=True, kw_only=True)
class PerspectiveJointSettings:
    """Settings of the joint solution; chosen by hand, results were not measured against other values."""

    step_iterations: int = 60
    """Largest number of conjugate gradient steps of a Gauss-Newton step."""
    draw_iterations: int = 150
    """Largest number of conjugate gradient steps of a random draw."""
    shortest_step: float = 0.02
    """Gauss-Newton steps that must be shortened below this fraction are not taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointEquations:
    """Equations of the frames' unknowns (F, 6 + M) and of the basis shapes (P, 3 + 3M) together."""

    model: PerspectiveModel
    """Model about which the equations are linearised."""
    jacobian: Floats
    """(F, 2P, 6 + M) derivatives of the image by the frames' unknowns, over the noise."""
    by_shape: Floats
    """(F, 2, 3, P) derivatives of the image by the shapes, over the noise."""
    by_weight: Floats
    """(F, E, M) derivatives of the distances by the weights, over their standard deviation."""
    direction: Floats
    """(F, 3, E) derivatives of the distances by the first point, over the same standard deviation."""
    ends: Floats
    """(E, P) incidence matrix: 1 at the first point of a pair, -1 at the second."""
    frames: tuple[Floats, Floats, Floats, Floats]
    """Equations of the frames alone, in the form of `solve_banded`."""
    shapes: ShapeEquations
    """Equations of the basis shapes alone."""

    def from_points(self, image: Floats, lengths: Floats) -> Floats:
        """Multiply values of image (F, 2P) and distances (F, E) by the transposed derivatives by the basis shapes."""
        frames, _, _, points = self.by_shape.shape
        pull = np.einsum("fkip,fkp->fip", self.by_shape, image.reshape(frames, 2, points))
        pull += (self.direction * lengths[:, None]) @ self.ends
        return in_rows(np.tensordot(self.model.row, pull, (0, 0)))

    def from_frames(self, image: Floats, lengths: Floats) -> Floats:
        """Multiply such values by the transposed derivatives by the frames' unknowns."""
        out = products(np.swapaxes(self.jacobian, 1, 2), image)
        out[:, MOTION:] += products(np.swapaxes(self.by_weight, 1, 2), lengths)
        return np.asarray(out)

    def times(self, frames: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """Multiply the matrix with values of the frames (F, 6 + M) and of the basis shapes (P, 3 + 3M)."""
        moved = np.tensordot(self.model.row, in_shapes(rows), 1)
        image = np.einsum("fkip,fip->fkp", self.by_shape, moved).reshape(len(moved), -1)
        lengths = (self.direction * (moved @ self.ends.T)).sum(1)
        image_too = products(self.jacobian, frames)
        lengths_too = (self.by_weight @ frames[:, MOTION:, None])[..., 0]
        own = _banded(*self.frames[:3], frames) + self.from_frames(image, lengths)
        return own, self.shapes.times(rows) + self.from_points(image_too, lengths_too)

    def solve(self, frames: Floats, rows: Floats, rounds: int) -> tuple[Floats, Floats]:
        """Solve for given right-hand sides with at most `rounds` conjugate gradient steps."""
        band = scipy.linalg.cholesky_banded(_band(*self.frames[:3]), lower=True, check_finite=False)
        inverse, size = np.linalg.inv(self.shapes.diagonal), frames.size

        def conditioned(values: Floats) -> Floats:
            first = scipy.linalg.cho_solve_banded((band, True), values[:size], check_finite=False)
            return np.concatenate([first, (inverse @ values[size:].reshape(*rows.shape, 1)).ravel()])

        def system(values: Floats) -> Floats:
            sides = self.times(values[:size].reshape(frames.shape), values[size:].reshape(rows.shape))
            return np.concatenate([side.ravel() for side in sides])

        left = np.concatenate([frames.ravel(), rows.ravel()])
        found, turned = np.zeros_like(left), conditioned(left)
        direction, length = turned, float(left @ turned)
        enough = _TOLERANCE**2 * length
        for _ in range(rounds):
            if length <= enough:
                break
            ahead = system(direction)
            share = length / float(direction @ ahead)
            found, left = found + share * direction, left - share * ahead
            turned = conditioned(left)
            now = float(left @ turned)
            direction, length = turned + now / length * direction, now
        return found[:size].reshape(frames.shape), found[size:].reshape(rows.shape)


def joint_equations(model: PerspectiveModel, tracks: Floats, seen: Floats, *, certain: bool = False) -> JointEquations:
    """Compute the equations about a model; `certain` ignores the uncertainty of the frames in the shapes' part."""
    _, jacobian = residuals_and_jacobians(model, tracks, seen)
    sharp, tight = 1 / np.sqrt(model.variance), np.sqrt(model.distance_weight / model.distance_variance)
    frames, count, points = len(tracks), len(model.pairs), tracks.shape[2]
    ends, own = np.zeros((count, points)), np.arange(count)
    ends[own, model.pairs[:, 0]], ends[own, model.pairs[:, 1]] = 1, -1
    return JointEquations(
        model=model, jacobian=jacobian.reshape(frames, 2 * points, -1) * sharp, ends=ends,
        by_shape=np.einsum("fkip,fij->fkjp", image_residuals(model, tracks, seen)[1], model.rotation) * sharp,
        by_weight=distance_jacobians(model)[1] * tight[:, None],
        direction=lengths_of(model.shapes, model.pairs)[1] * tight, frames=frame_equations(model, tracks, seen),
        shapes=basis_equations(model, tracks, seen, certain=certain),
    )  # fmt: skip


def refine_jointly(
    model: PerspectiveModel,
    tracks: Floats,
    seen: Floats,
    rounds: int,
    least_noise: float,
    settings: PerspectiveJointSettings = PerspectiveJointSettings(),
) -> None:
    """Do rounds in which motion and shapes are solved together; covariance and cost belong to the final estimate.

    Args:
        model: Changed in place.
        tracks: (F, 2, P) normalised image coordinates, with arbitrary values where not seen.
        seen: (F, P) 1 where seen, else 0.
        rounds: Largest number of rounds.
        least_noise: Least standard deviation of a normalised image coordinate.
        settings: Numbers of iterations.
    """
    share = 1.0
    for _ in range(rounds):
        solve_frames(model, tracks, seen)
        share = _step(model, tracks, seen, min(1.0, 2 * share), settings)
        solve_shapes(model, tracks, seen)
        solve_variances(model, tracks, seen, least_noise)
        if share < settings.shortest_step:
            break
    solve_frames(model, tracks, seen)


def _step(
    model: PerspectiveModel, tracks: Floats, seen: Floats, share: float, settings: PerspectiveJointSettings
) -> float:
    """Do one step, shortened until the cost falls after a round of each half; return the fraction of it."""
    equations = joint_equations(model, tracks, seen)
    right = equations.shapes.right - equations.shapes.times(in_rows(np.concatenate([model.mean[None], model.modes])))
    step, rows = equations.solve(equations.frames[3], right, settings.step_iterations)
    basis, before = in_shapes(rows), model.cost
    share = min(share, model.settings.longest_turn / max(float(np.abs(step[:, :3]).max()), 1e-300))
    while share >= settings.shortest_step:
        tried = _moved_by(model, share * step, share * basis)
        if _solved_in_turn(tried, tracks, seen) and tried.cost < before:
            for field in fields(model):
                setattr(model, field.name, getattr(tried, field.name))
            return share
        share /= 2
    return share


def _solved_in_turn(model: PerspectiveModel, tracks: Floats, seen: Floats) -> bool:
    """Solve for frames, shapes and frames again; return whether this was possible."""
    if not np.isfinite(negative_log_probability(model, tracks, seen)):
        return False
    try:
        solve_frames(model, tracks, seen)
        solve_shapes(model, tracks, seen)
        solve_frames(model, tracks, seen)
    except np.linalg.LinAlgError:
        return False
    return True


def _moved_by(model: PerspectiveModel, step: Floats, basis: Floats) -> PerspectiveModel:
    moved = replace(
        model, rotation=rotations.exp(step[:, :3]) @ model.rotation, shift=model.shift + step[:, 3:MOTION],
        weights=model.weights + step[:, MOTION:], mean=model.mean + basis[0], modes=model.modes + basis[1:],
        processes=copy(model.processes),
    )  # fmt: skip
    set_gauge(moved)
    return moved


def posterior_draws(
    model: PerspectiveModel,
    tracks: Floats,
    seen: Floats,
    count: int,
    rng: np.random.Generator,
    settings: PerspectiveJointSettings = PerspectiveJointSettings(),
) -> Iterator[PerspectiveStart]:
    """Draw solutions from the joint posterior of motion and shapes, to first order ([Papandreou2010]).

    Each draw solves the joint equations for right-hand sides with the covariance of the tracks' noise and the priors.

    Args:
        model: Estimate about which solutions are drawn.
        tracks: (F, 2, P) normalised image coordinates.
        seen: (F, P) 1 where seen, else 0.
        count: Number of draws.
        rng: Source of randomness.
        settings: Numbers of iterations.

    Yields:
        Poses and shapes.
    """
    equations = joint_equations(model, tracks, seen, certain=True)
    frames, points = len(tracks), tracks.shape[2]
    for _ in range(count):
        image, lengths = rng.normal(size=(frames, 2 * points)), rng.normal(size=equations.direction.shape[::2])
        right = equations.from_frames(image, lengths) + _random_priors(model, rng)
        rows = equations.from_points(image, lengths)
        rows[:, 3:] += rng.normal(size=rows[:, 3:].shape)
        step, rows = equations.solve(right, rows, settings.draw_iterations)
        basis = in_shapes(rows)
        away = np.tensordot(model.row, basis, 1) + np.tensordot(step[:, MOTION:], model.modes, 1)
        yield _without_motion(model, step, away)


def _random_priors(model: PerspectiveModel, rng: np.random.Generator) -> Floats:
    """Draw right-hand sides of the frames (F, 6 + M) with the covariance of the priors of motion and weights."""
    frames, modes = model.weights.shape
    right = np.zeros((frames, MOTION + modes))
    turns, shifts = (rng.normal(size=(frames - 2, 3)) / np.sqrt(variance) for variance in model.acceleration_variances)
    innovations = rng.normal(size=(frames - 2, modes)) / np.sqrt(model.processes.innovation_variance)
    by_process = (-model.processes.autoregression[:, 1], -model.processes.autoregression[:, 0], 1.0)
    by_turn = acceleration_jacobians(model.rotation)
    for k in range(3):
        span = slice(k, frames - 2 + k)
        right[span, :3] += np.einsum("fij,fi->fj", by_turn[k], turns)
        right[span, 3:MOTION] += (1.0, -2.0, 1.0)[k] * shifts
        right[span, MOTION:] += by_process[k] * innovations
    right[:2, MOTION:] += rng.normal(size=(2, modes)) / np.sqrt(model.processes.weight_variance)
    return right


def _without_motion(model: PerspectiveModel, step: Floats, away: Floats) -> PerspectiveStart:
    """Convert a draw whose shapes differ by `away` (F, 3, P) to poses and shapes in the gauge of the model."""
    middle = away.mean(2)
    inertia = (model.mean**2).sum() * np.eye(3) - model.mean @ model.mean.T
    moments = np.cross(model.mean.T[None], np.swapaxes(away, 1, 2)).sum(1)
    turns = np.linalg.solve(inertia, moments.T).T
    away = away - middle[:, :, None] - np.swapaxes(np.cross(turns[:, None], model.mean.T[None]), 1, 2)
    turned = step[:, :3] + np.einsum("fij,fj->fi", model.rotation, turns)
    shift = model.shift + step[:, 3:MOTION] + np.einsum("fij,fj->fi", model.rotation, middle)
    return PerspectiveStart(rotation=rotations.exp(turned) @ model.rotation, shift=shift, shapes=model.shapes + away)


def _banded(diagonal: Floats, first: Floats, second: Floats, values: Floats) -> Floats:
    """Multiply the matrix of `solve_banded` with values (F, D)."""
    out = products(diagonal, values)
    for k, blocks in ((1, first[:-1]), (2, second[:-2])):
        out[:-k] += products(blocks, values[k:])
        out[k:] += products(np.swapaxes(blocks, 1, 2), values[:-k])
    return out


def _band(diagonal: Floats, first: Floats, second: Floats) -> Floats:
    """Rearrange the matrix of `solve_banded` into a lower band as used by LAPACK, (3D, F D)."""
    frames, size = diagonal.shape[:2]
    rows = np.zeros((frames, size, 3 * size))
    rows[:, :, :size] = diagonal
    rows[:-1, :, size : 2 * size], rows[:-2, :, 2 * size :] = first[:-1], second[:-2]
    band = np.zeros((3 * size, frames * size))
    for i in range(size):
        band[: 3 * size - i, i::size] = rows[:, i, i:].T
    return band
