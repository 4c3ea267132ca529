"""Motion and shapes of the model in perspective moved together, and draws from what is not known of both together.

Solved in turns, motion and shapes creep where they can follow each other, and each takes the other for certain: a
covariance of the frames alone is too small by up to forty times. Here the equations of both are solved together, by
conjugate gradients of which either half is a preconditioner's block.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.linalg

from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.core.rotation_paths import acceleration_jacobians
from marey.nonrigid.one_camera.perspective_model import (
    LONGEST_TURN,
    MOTION,
    PerspectiveModel,
    distance_jacobians,
    equations_of_shapes,
    frame_equations,
    improbability,
    lengths_of,
    residuals_and_jacobians,
    seen_from,
    set_gauge,
    solve_frames,
    solve_shapes,
    solve_variances,
)
from marey.nonrigid.one_camera.perspective_starts import Start
from marey.nonrigid.one_camera.shape_equations import ShapeEquations, in_rows, in_shapes

STEPPING_ROUNDS, DRAWING_ROUNDS = 60, 150
STILL = 1e-3
SHORTEST = 0.02
"""A step that must be shortened below this share is not taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointEquations:
    """Equations of the frames' unknowns (F, 6 + M) and the basis shapes (P, 3 + 3M) together."""

    model: PerspectiveModel
    jacobian: Floats
    """(F, 2P, 6 + M) of the image by the frames' unknowns, over the noise."""
    by_shape: Floats
    """(F, 2, 3, P) of the image by the shapes, over the noise."""
    by_weight: Floats
    """(F, E, M) of the distances by the weights, over their standard deviation."""
    direction: Floats
    """(F, 3, E) of the distances by the first point, over the same."""
    ends: Floats
    """(E, P) 1 at the first point of a pair, -1 at the second."""
    frames: tuple[Floats, Floats, Floats, Floats]
    """As `solve_banded` takes them."""
    shapes: ShapeEquations

    def from_points(self, image: Floats, lengths: Floats) -> Floats:
        """Carry values of the image (F, 2P) and of distances (F, E) to the basis shapes."""
        frames, _, _, points = self.by_shape.shape
        pull = np.einsum("fkip,fkp->fip", self.by_shape, image.reshape(frames, 2, points))
        pull += (self.direction * lengths[:, None]) @ self.ends
        return in_rows(np.tensordot(self.model.row, pull, (0, 0)))

    def from_frames(self, image: Floats, lengths: Floats) -> Floats:
        """Carry them to the frames' unknowns."""
        out = (np.swapaxes(self.jacobian, 1, 2) @ image[..., None])[..., 0]
        out[:, MOTION:] += (np.swapaxes(self.by_weight, 1, 2) @ lengths[..., None])[..., 0]
        return np.asarray(out)

    def times(self, frames: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """Give the left sides of some values."""
        moved = np.tensordot(self.model.row, in_shapes(rows), 1)
        image = np.einsum("fkip,fip->fkp", self.by_shape, moved).reshape(len(moved), -1)
        lengths = (self.direction * (moved @ self.ends.T)).sum(1)
        image_too = (self.jacobian @ frames[..., None])[..., 0]
        lengths_too = (self.by_weight @ frames[:, MOTION:, None])[..., 0]
        own = _banded(*self.frames[:3], frames) + self.from_frames(image, lengths)
        return own, self.shapes.times(rows) + self.from_points(image_too, lengths_too)

    def solve(self, frames: Floats, rows: Floats, rounds: int) -> tuple[Floats, Floats]:
        """Solve for given right sides."""
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
        enough = STILL**2 * length
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
    """Write the equations about a model; `certain` leaves out of the shapes' part what is not known of the frames."""
    _, jacobian = residuals_and_jacobians(model, tracks, seen)
    sharp, tight = 1 / np.sqrt(model.variance), np.sqrt(model.share / model.stretch)
    frames, count, points = len(tracks), len(model.pairs), tracks.shape[2]
    ends, own = np.zeros((count, points)), np.arange(count)
    ends[own, model.pairs[:, 0]], ends[own, model.pairs[:, 1]] = 1, -1
    return JointEquations(
        model=model, jacobian=jacobian.reshape(frames, 2 * points, -1) * sharp, ends=ends,
        by_shape=np.einsum("fkip,fij->fkjp", seen_from(model, tracks, seen)[1], model.rotation) * sharp,
        by_weight=distance_jacobians(model)[1] * tight[:, None],
        direction=lengths_of(model.shapes, model.pairs)[1] * tight, frames=frame_equations(model, tracks, seen),
        shapes=equations_of_shapes(model, tracks, seen, certain=certain),
    )  # fmt: skip


def improve_jointly(model: PerspectiveModel, tracks: Floats, seen: Floats, rounds: int, least_noise: float) -> None:
    """Do rounds in which motion and shapes move together; covariance and cost are those of the end."""
    share = 1.0
    for _ in range(rounds):
        solve_frames(model, tracks, seen)
        share = _step(model, tracks, seen, min(1.0, 2 * share))
        solve_shapes(model, tracks, seen)
        solve_variances(model, tracks, seen, least_noise)
        if share < SHORTEST:
            break
    solve_frames(model, tracks, seen)


def _step(model: PerspectiveModel, tracks: Floats, seen: Floats, share: float) -> float:
    """Do one step, shortened until it is more probable once either half has settled; give the share of it."""
    equations = joint_equations(model, tracks, seen)
    right = equations.shapes.right - equations.shapes.times(in_rows(np.concatenate([model.mean[None], model.modes])))
    step, rows = equations.solve(equations.frames[3], right, STEPPING_ROUNDS)
    basis, before = in_shapes(rows), model.cost
    share = min(share, LONGEST_TURN / max(float(np.abs(step[:, :3]).max()), 1e-300))
    while share >= SHORTEST:
        tried = _moved_by(model, share * step, share * basis)
        if _settled(tried, tracks, seen) and tried.cost < before:
            for field in fields(model):
                setattr(model, field.name, getattr(tried, field.name))
            return share
        share /= 2
    return share


def _settled(model: PerspectiveModel, tracks: Floats, seen: Floats) -> bool:
    """Let either half settle, and tell whether there was a way."""
    if not np.isfinite(improbability(model, tracks, seen)):
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


def draws(
    model: PerspectiveModel, tracks: Floats, seen: Floats, count: int, rng: np.random.Generator
) -> Iterator[Start]:
    """Draw answers from what is not known of motion and shapes together, to first order ([Papandreou2010]).

    Each solves the joint equations for right sides as random as the tracks' noise and what is believed beforehand.
    """
    equations = joint_equations(model, tracks, seen, certain=True)
    frames, points = len(tracks), tracks.shape[2]
    for _ in range(count):
        image, lengths = rng.normal(size=(frames, 2 * points)), rng.normal(size=equations.direction.shape[::2])
        right = equations.from_frames(image, lengths) + _random_beliefs(model, rng)
        rows = equations.from_points(image, lengths)
        rows[:, 3:] += rng.normal(size=rows[:, 3:].shape)
        step, rows = equations.solve(right, rows, DRAWING_ROUNDS)
        basis = in_shapes(rows)
        away = np.tensordot(model.row, basis, 1) + np.tensordot(step[:, MOTION:], model.modes, 1)
        yield _parted(model, step, away)


def _random_beliefs(model: PerspectiveModel, rng: np.random.Generator) -> Floats:
    """Draw right sides of the frames (F, 6 + M) whose covariance is what is believed of the motion and the weights."""
    frames, modes = model.weights.shape
    right = np.zeros((frames, MOTION + modes))
    turns, shifts = (rng.normal(size=(frames - 2, 3)) / np.sqrt(variance) for variance in model.unsteadiness)
    surprises = rng.normal(size=(frames - 2, modes)) / np.sqrt(model.processes.surprise)
    by_memory = (-model.processes.memory[:, 1], -model.processes.memory[:, 0], 1.0)
    by_turn = acceleration_jacobians(model.rotation)
    for k in range(3):
        span = slice(k, frames - 2 + k)
        right[span, :3] += np.einsum("fij,fi->fj", by_turn[k], turns)
        right[span, 3:MOTION] += (1.0, -2.0, 1.0)[k] * shifts
        right[span, MOTION:] += by_memory[k] * surprises
    right[:2, MOTION:] += rng.normal(size=(2, modes)) / np.sqrt(model.processes.spread)
    return right


def _parted(model: PerspectiveModel, step: Floats, away: Floats) -> Start:
    """Give a draw whose shapes depart by `away` (F, 3, P), the motion in it parted off as the model's is."""
    middle = away.mean(2)
    inertia = (model.mean**2).sum() * np.eye(3) - model.mean @ model.mean.T
    moments = np.cross(model.mean.T[None], np.swapaxes(away, 1, 2)).sum(1)
    turns = np.linalg.solve(inertia, moments.T).T
    away = away - middle[:, :, None] - np.swapaxes(np.cross(turns[:, None], model.mean.T[None]), 1, 2)
    turned = step[:, :3] + np.einsum("fij,fj->fi", model.rotation, turns)
    shift = model.shift + step[:, 3:MOTION] + np.einsum("fij,fj->fi", model.rotation, middle)
    return Start(rotation=rotations.exp(turned) @ model.rotation, shift=shift, shapes=model.shapes + away)


def _banded(diagonal: Floats, first: Floats, second: Floats, values: Floats) -> Floats:
    """Multiply the matrix of `solve_banded` with values (F, D)."""

    def each(blocks: Floats, of: Floats) -> Floats:
        return np.asarray((blocks @ of[..., None])[..., 0])

    out = each(diagonal, values)
    for k, blocks in ((1, first[:-1]), (2, second[:-2])):
        out[:-k] += each(blocks, values[k:])
        out[k:] += each(np.swapaxes(blocks, 1, 2), values[:-k])
    return out


def _band(diagonal: Floats, first: Floats, second: Floats) -> Floats:
    """Give the same as LAPACK keeps a lower band: (3D, F D)."""
    frames, size = diagonal.shape[:2]
    rows = np.zeros((frames, size, 3 * size))
    rows[:, :, :size] = diagonal
    rows[:-1, :, size : 2 * size], rows[:-2, :, 2 * size :] = first[:-1], second[:-2]
    band = np.zeros((3 * size, frames * size))
    for i in range(size):
        band[: 3 * size - i, i::size] = rows[:, i, i:].T
    return band
