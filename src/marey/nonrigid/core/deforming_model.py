"""Gaussian model of a deforming shape before one or more orthographic cameras, fitted by expectation maximisation.

Frame f shows P R_f (M + c_f1 B_1 + ...) + t_f with white noise. P is the first two rows of the identity for one camera,
and the stacked rows of all cameras for several that are fixed to each other. The weights c are second-order
autoregressive processes, and the angular acceleration of the camera is white noise; their parameters are estimated.
Rotations, shifts and weights of all frames are solved together by Gauss-Newton, with their covariance; then the shapes
point by point; then the noise and the processes. Unlike [Torresani2008], where the processes are of first order and the
camera is not part of the same equations.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations
from marey.nonrigid.core import kept_lengths
from marey.nonrigid.core.block_banded import solve_banded
from marey.nonrigid.core.completion import singular_vectors
from marey.nonrigid.core.kept_lengths import KeptLengths
from marey.nonrigid.core.rotation_paths import (
    LONGEST_TURN,
    acceleration_jacobians,
    accelerations,
    add_acceleration_penalty,
)
from marey.nonrigid.core.weight_processes import INITIAL_AUTOREGRESSION, WeightProcesses, estimated_processes

ONE_CAMERA = np.eye(2, 3)
"""Projection by a single orthographic camera along the third axis."""
TURN = 3
"""Number of rotation unknowns of a frame, which come first; two shift unknowns per camera follow, then the weights."""
COST_PER_MODE_POINT = 1.5
"""Cost in `basis_cost` of a point in a mode: one half for each of its three coordinates (Laplace's approximation)."""


@dataclass(frozen=True, kw_only=True)
class DeformingModelSettings:
    """Numerical settings of the Gaussian model of a deforming shape."""

    longest_turn: float = LONGEST_TURN
    """Gauss-Newton steps are shortened so that no rotation vector component exceeds this [rad]; as for paths."""
    least_acceleration_sd: float = 1e-6
    """Least standard deviation of the camera's angular acceleration [rad per frame squared]; keeps exact data
    solvable."""
    least_variance: float = 1e-12
    """Added to initial variances of the weights, as a fraction of the mean shape's mean square; keeps rigid shapes
    solvable."""
    least_noise: float = 1e-6
    """Least standard deviation of the noise, as a fraction of the object's size; keeps exact data solvable."""


@dataclass
class DeformingModel:
    """Estimates of the model's parameters and of the sequence; the functions below change it in place."""

    rotation: Floats
    """(F, 3, 3) first camera from object."""
    shift: Floats
    """(F, 2C) translation in the images."""
    mean: Floats
    """(3, P) mean shape."""
    modes: Floats
    """(M, 3, P) deformation modes."""
    weights: Floats
    """(F, M)."""
    processes: WeightProcesses
    """Autoregressive processes of the weights."""
    acceleration_variance: float
    """Variance of the camera's angular acceleration [rad2]."""
    variance: float
    """Variance of a track coordinate about the model."""
    covariance: tuple[Floats, Floats, Floats]
    """(F, D, D) of each frame's unknowns, with those of the next frame and of the next but one; D = 3 + 2C + M."""
    projection: Floats
    """(2C, 3) stacked projections of the cameras, from the first camera's axes."""
    cost: float = np.inf
    """Minus the log-probability of the tracks, up to a constant."""
    lengths: KeptLengths | None = None
    """Distances that are constrained to stay constant, if any."""
    settings: DeformingModelSettings = DeformingModelSettings()
    """Numerical settings."""

    @property
    def shapes(self) -> Floats:
        """(F, 3, P) shapes in the object's frame."""
        moved = self.weights @ self.modes.reshape(len(self.modes), self.mean.size)
        return np.asarray(self.mean + moved.reshape(-1, *self.mean.shape))

    @property
    def first_weight(self) -> int:
        """Index of the first weight among a frame's unknowns."""
        return TURN + len(self.projection)

    def mode_sizes(self) -> Floats:
        """Compute the displacement by each mode (M,), root mean square over frames and points."""
        points = self.mean.shape[1]
        return np.asarray(np.sqrt((self.weights**2).mean(0) * (self.modes**2).sum((1, 2)) / points))


def initial_model(
    tracks: Floats,
    seen: Floats,
    rotation: Floats,
    shapes: Floats,
    modes: int,
    noise: float,
    projection: Floats = ONE_CAMERA,
    settings: DeformingModelSettings = DeformingModelSettings(),
) -> DeformingModel:
    """Create a model from rotations and shapes.

    Args:
        tracks: (F, 2C, P), with arbitrary finite values where not seen.
        seen: (F, P), or (F, C, P) for several cameras.
        rotation: (F, 3, 3) first camera from object.
        shapes: (F, 3, P).
        modes: Largest number of modes.
        noise: Initial standard deviation of a coordinate, in the tracks' unit.
        projection: (2C, 3) stacked projections of the cameras.
        settings: Numerical settings.
    """
    shapes = shapes - shapes.mean(2, keepdims=True)
    frames, _, points = shapes.shape
    mean = shapes.mean(0)
    u, d, vt = singular_vectors((shapes - mean).reshape(frames, -1))
    modes = min(modes, len(d))
    weights = u[:, :modes] * d[:modes] / np.sqrt(points)
    autoregression = np.tile(INITIAL_AUTOREGRESSION, (modes, 1))
    predicted = autoregression[:, 0] * weights[1:-1] + autoregression[:, 1] * weights[:-2]
    floor = settings.least_variance * float(np.mean(mean**2))
    innovation = ((weights[2:] - predicted) ** 2).mean(0) + floor
    unknowns = TURN + len(projection) + modes
    model = DeformingModel(
        rotation=rotation, projection=projection, shift=np.zeros((frames, len(projection))),
        mean=mean, weights=weights, modes=(vt[:modes] * np.sqrt(points)).reshape(modes, 3, points),
        processes=WeightProcesses((weights**2).mean(0) + floor, autoregression, innovation),
        acceleration_variance=max(
            float((accelerations(rotation) ** 2).mean()), settings.least_acceleration_sd**2
        ),
        variance=noise**2, covariance=(np.zeros((frames, unknowns, unknowns)),) * 3, settings=settings,
    )  # fmt: skip
    rows = by_row(seen)
    model.shift = ((tracks - projection @ rotation @ shapes) * rows).sum(2) / np.maximum(rows.sum(2), 1)
    return model


def by_row(seen: Floats) -> Floats:
    """Repeat values of points, (F, P) or (F, C, P), for both of their coordinates, (F, 2C, P)."""
    return np.repeat(seen.reshape(len(seen), -1, seen.shape[-1]), 2, axis=1)


def residuals_and_jacobians(model: DeformingModel, tracks: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Compute residuals (F, 2C, P) and the model's derivatives (F, 2C, P, D) by left rotation, shift and weights."""
    frames, count, points = tracks.shape
    known = by_row(seen)
    carried = model.rotation @ model.shapes
    residual = (tracks - model.projection @ carried - model.shift[:, :, None]) * known
    jacobian = np.zeros((frames, count, points, model.first_weight + len(model.modes)))
    for row, sight in enumerate(model.projection):
        # a rotation d moves the point y by d x y, and its projection on a row p by p . (d x y) = d . (y x p)
        jacobian[:, row, :, :TURN] = np.cross(np.swapaxes(carried, 1, 2), sight)
        jacobian[:, row, :, TURN + row] = 1
    by_weight = model.projection @ model.rotation @ model.modes.transpose(1, 2, 0).reshape(3, -1)
    jacobian[..., model.first_weight :] = by_weight.reshape(frames, count, points, -1)
    if not known.all():
        jacobian *= known[..., None]
    return residual, jacobian


def solve_frames(model: DeformingModel, tracks: Floats, seen: Floats) -> None:
    """Do one Gauss-Newton step of all frames together, and set covariance and cost."""
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    frames, unknowns = len(tracks), jacobian.shape[-1]
    flat = jacobian.reshape(frames, -1, unknowns)
    turned = np.swapaxes(flat, 1, 2)
    diagonal = turned @ flat / model.variance
    right = (turned @ residual.reshape(frames, -1, 1))[..., 0] / model.variance
    # keeps the equations solvable where a frame, or the shift of a camera, is not observed
    diagonal[:, range(model.first_weight), range(model.first_weight)] += 1e-8
    first, second = np.zeros_like(diagonal), np.zeros_like(diagonal)
    add_acceleration_penalty(diagonal, first, second, right, model.rotation, 1 / model.acceleration_variance)
    innovations = model.processes.add(diagonal, first, second, right, model.weights, model.first_weight)
    if model.lengths is not None:
        normal, side = kept_lengths.weight_equations(model.lengths, model.shapes, model.modes)
        diagonal[:, model.first_weight :, model.first_weight :] += normal
        right[:, model.first_weight :] += side
    step, *covariance, determinant = solve_banded(diagonal, first, second, right)
    model.covariance = (covariance[0], covariance[1], covariance[2])
    model.cost = 0.5 * (
        float((residual**2).sum()) / model.variance
        + float((accelerations(model.rotation) ** 2).sum()) / model.acceleration_variance
        + innovations + determinant + 2 * float(seen.sum()) * np.log(model.variance)
        + 3 * (frames - 2) * np.log(model.acceleration_variance)
        + float(
            (frames - 2) * np.log(model.processes.innovation_variance).sum()
            + 2 * np.log(model.processes.weight_variance).sum()
        )
    ) + (0.0 if model.lengths is None else kept_lengths.cost(model.lengths, model.shapes))  # fmt: skip
    share = min(1.0, model.settings.longest_turn / max(float(np.abs(step[:, :3]).max()), 1e-300))
    model.rotation = rotations.exp(share * step[:, :3]) @ model.rotation
    model.shift = model.shift + share * step[:, TURN : model.first_weight]
    model.weights = model.weights + share * step[:, model.first_weight :]


def solve_shapes(model: DeformingModel, tracks: Floats, seen: Floats) -> None:
    """Solve for the mean shape and the modes of each point, given the estimates of the frames."""
    points = tracks.shape[2]
    row, square = _expected_weights(model)
    rows = model.projection @ model.rotation
    blocks = _track_information(model, seen)
    left = (tracks - model.shift[:, :, None]) * by_row(seen)
    side = np.swapaxes(rows, 1, 2) @ left / model.variance
    if model.lengths is not None:
        # Both ends of a pair move at once: each is penalised twice as much, so that together they do not overshoot.
        held, pull = kept_lengths.point_equations(model.lengths, model.shapes)
        blocks += 2 * held
        side += pull
    normal = _point_normals(square, blocks)
    right = (row.T @ side.reshape(len(row), -1)).reshape(-1, 3, points).transpose(2, 0, 1).reshape(points, -1)
    if model.lengths is not None:
        before = np.concatenate([model.mean[None], model.modes]).transpose(2, 0, 1).reshape(points, -1)
        right += (_point_normals(square, 2 * held) @ before[..., None])[..., 0]
    unknowns = normal.shape[1]
    normal[:, range(unknowns), range(unknowns)] += 1e-9 * np.einsum("pnn->p", normal)[:, None] / unknowns
    solved = np.linalg.solve(normal, right[..., None]).reshape(points, -1, 3)
    model.mean, model.modes = solved[:, 0].T, np.moveaxis(solved[:, 1:], 0, 2)
    middle, middles = model.mean.mean(1), model.modes.mean(2)
    model.mean, model.modes = model.mean - middle[:, None], model.modes - middles[:, :, None]
    model.shift = model.shift + np.einsum("fij,fj->fi", rows, middle + model.weights @ middles)


def _expected_weights(model: DeformingModel) -> tuple[Floats, Floats]:
    """Compute 1 and the weights of each frame (F, 1 + M), and their expected products (F, 1 + M, 1 + M)."""
    row = np.concatenate([np.ones((len(model.weights), 1)), model.weights], 1)
    square = row[:, :, None] * row[:, None]
    square[:, 1:, 1:] += model.covariance[0][:, model.first_weight :, model.first_weight :]
    return row, square


def _track_information(model: DeformingModel, seen: Floats) -> Floats:
    """Compute the information (F, P, 3, 3) of the tracks about each point, as inverse covariance."""
    cameras = seen.reshape(len(seen), -1, seen.shape[-1]) / model.variance
    blocks = np.zeros((len(seen), seen.shape[-1], 3, 3))
    for camera in range(cameras.shape[1]):
        rows = model.projection[2 * camera : 2 * camera + 2] @ model.rotation
        blocks += (np.swapaxes(rows, 1, 2) @ rows)[:, None] * cameras[:, camera, :, None, None]
    return blocks


def _point_normals(square: Floats, blocks: Floats) -> Floats:
    """Compute the normal matrix (P, 3 + 3M, 3 + 3M) of each point's mean position and modes."""
    frames, count, _ = square.shape
    points = blocks.shape[1]
    normal = square.reshape(frames, -1).T @ blocks.reshape(frames, -1)
    return normal.reshape(count, count, points, 3, 3).transpose(2, 0, 3, 1, 4).reshape(points, 3 * count, 3 * count)


def shape_variance(model: DeformingModel, seen: Floats) -> Floats:
    """Compute the variance (F, 3, P) of the shapes, from those of the weights given the modes and vice versa.

    The prior of a mode's coordinate has standard deviation 1.

    Args:
        model: After `refine`.
        seen: (F, P) or (F, C, P).
    """
    of_weights = model.covariance[0][:, model.first_weight :, model.first_weight :]
    by_weight = np.moveaxis(model.modes, 0, 2).reshape(model.mean.size, len(model.modes))
    first = ((by_weight @ of_weights) * by_weight).sum(2).reshape(len(seen), *model.mean.shape)
    _, square = _expected_weights(model)
    blocks = _track_information(model, seen)
    if model.lengths is not None:
        blocks += kept_lengths.point_equations(model.lengths, model.shapes)[0]
    normal = _point_normals(square, blocks)
    normal[:, range(normal.shape[1]), range(normal.shape[1])] += 1
    points, count = len(normal), square.shape[1]
    inverse = np.linalg.inv(normal).reshape(points, count, 3, count, 3)
    axes = np.einsum("paibi->iabp", inverse).reshape(3, count * count, points)
    return np.asarray(first + np.swapaxes(square.reshape(len(seen), -1) @ axes, 0, 1))


def solve_processes(model: DeformingModel, tracks: Floats, seen: Floats, least_noise: float) -> None:
    """Estimate the noise, the weights' processes and the camera's acceleration variance."""
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    frames = len(tracks)
    flat = jacobian.reshape(frames, -1, jacobian.shape[-1])
    uncertainty = float(np.einsum("fde,fde->", np.swapaxes(flat, 1, 2) @ flat, model.covariance[0]))
    model.variance = max((float((residual**2).sum()) + uncertainty) / (2 * float(seen.sum())), least_noise**2)
    here, near, far = (part[:, model.first_weight :, model.first_weight :] for part in model.covariance)
    model.processes = estimated_processes(model.weights, (here, near, far))
    model.acceleration_variance = max(_mean_square_acceleration(model), model.settings.least_acceleration_sd**2)
    if model.lengths is not None:
        _, along = kept_lengths.departures(model.lengths, model.shapes)
        by_weight = kept_lengths.derivatives(model.lengths, along, model.modes)
        variance = ((by_weight @ here) * by_weight).sum(2).mean(0)
        model.lengths = kept_lengths.estimated_lengths(
            model.lengths.pairs, model.shapes, variance, settings=model.lengths.settings
        )


def _mean_square_acceleration(model: DeformingModel) -> float:
    """Compute the expected mean square of the camera's angular acceleration, including its uncertainty."""
    jacobians = acceleration_jacobians(model.rotation)
    frames = len(model.rotation)
    total = float((accelerations(model.rotation) ** 2).sum())
    for i in range(3):
        for j in range(i, 3):
            part = model.covariance[j - i][i : frames - 2 + i, :3, :3]
            total += (1 + (j > i)) * float(np.einsum("fij,fjk,fik->", jacobians[i], part, jacobians[j], optimize=True))
    return total / (3 * (frames - 2))


def refine(model: DeformingModel, tracks: Floats, seen: Floats, rounds: int, least_noise: float = 0.0) -> None:
    """Do rounds of all three steps, then the first again, so that covariance and cost belong to the final estimate.

    Args:
        model: Changed in place.
        tracks: (F, 2C, P), with arbitrary finite values where not seen.
        seen: (F, P), or (F, C, P) for several cameras.
        rounds: Number of rounds.
        least_noise: Least standard deviation of the noise, in the tracks' unit.
    """
    floor = max(least_noise, model.settings.least_noise * float(np.sqrt(np.mean(model.mean**2))))
    for _ in range(rounds):
        solve_frames(model, tracks, seen)
        solve_shapes(model, tracks, seen)
        solve_processes(model, tracks, seen, floor)
    solve_frames(model, tracks, seen)


def keep_modes(model: DeformingModel, kept: Mask) -> None:
    """Remove all modes but those in the mask (M,)."""
    unknowns = np.concatenate([np.ones(model.first_weight, bool), kept])
    here, near, far = (part[:, unknowns][:, :, unknowns] for part in model.covariance)
    model.covariance = (here, near, far)
    model.modes, model.weights = model.modes[kept], model.weights[:, kept]
    model.processes = model.processes.among(np.flatnonzero(kept))


def basis_cost(model: DeformingModel) -> float:
    """Compute the loss of log-probability by the freedom of the modes, up to a constant (Laplace's approximation).

    The prior of a mode's coordinate has standard deviation 1 (modes have root mean square 1 per point). One camera
    observes two of three coordinates per frame, so the tracks narrow the prior by the square root of
    1 + 2 sum(c^2) / (3 noise^2).
    """
    share = float((model.projection**2).sum()) / 3
    weights = model.weights - model.weights.mean(0)
    left = np.einsum("fm,mip->fip", weights, model.modes).reshape(len(weights), -1)
    square = left @ left.T if len(left) < left.shape[1] else left.T @ left
    size = np.maximum(np.linalg.eigvalsh(square)[::-1][: len(model.modes)], 0)
    points = model.mean.shape[1]
    return float(COST_PER_MODE_POINT * points * np.log1p(share * size / (points * model.variance)).sum())
