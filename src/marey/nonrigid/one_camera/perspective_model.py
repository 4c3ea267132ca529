"""Gaussian model of a deforming shape before one camera in full perspective, fitted by expectation maximisation.

Frame f shows X = R_f (M + c_f1 B_1 + ...) + t_f at (X_1, X_2) / X_3 with white noise. As in `deforming_model`, the
weights are second-order autoregressive processes and the camera's angular acceleration is white noise. Here the shift
is in space, and its acceleration is white noise too; neighbouring points keep their distance up to a standard deviation
of each pair, which is estimated: small on skin and cloth, large across a joint.
"""

from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Integers
from marey.geometry import rotations
from marey.geometry.vectors import products
from marey.nonrigid.core.block_banded import solve_banded
from marey.nonrigid.core.rotation_paths import accelerations, add_acceleration_penalty
from marey.nonrigid.core.weight_processes import WeightProcesses, estimated_processes, initial_processes
from marey.nonrigid.one_camera.shape_equations import ShapeEquations, shape_equations, solve_shape_equations

MOTION = 6
"""Number of unknowns of a frame before its weights: three of the rotation, three of the shift."""
_LEAST_VARIANCE = 1e-12
"""Added to initial variances of the weights, in squared object sizes; keeps rigid shapes solvable."""
_LEAST_LENGTH = 1e-12
"""Least length by which vectors are divided, in object sizes; keeps coinciding points harmless."""


@dataclass(frozen=True, kw_only=True)
class PerspectiveModelSettings:
    """Settings of the Gaussian model in perspective; chosen by hand, results were not measured against other values."""

    longest_turn: float = 0.2
    """Gauss-Newton steps are shortened so that no rotation vector component exceeds this [rad]."""
    least_acceleration_sd: float = 1e-5
    """Least standard deviation of the camera's accelerations [rad, and fractions of the object's size, per frame
    squared]; keeps exact data solvable."""
    stretch_frames: float = 4.0
    """Number of frames that the common standard deviation of distances counts, beside a pair's own frames."""
    least_stretch: float = 0.005
    """Least standard deviation of a pair's distance, as a fraction of it. Standard deviations shrink to zero where each
    distance counts as one observation (docs/explanation/nonrigid.md)."""
    halvings: int = 6
    """Largest number of times that a step is halved."""
    least_mode_size: float = 1e-5
    """Modes that move the points by less than this fraction of the object's size are removed."""


@dataclass
class PerspectiveModel:
    """Estimates of the model's parameters and of the sequence, in normalised image coordinates; changed in place."""

    rotation: Floats
    """(F, 3, 3) camera from object."""
    shift: Floats
    """(F, 3) object's origin in camera axes; the mean shape's root mean square is 1."""
    mean: Floats
    """(3, P) mean shape."""
    modes: Floats
    """(M, 3, P) deformation modes."""
    weights: Floats
    """(F, M)."""
    processes: WeightProcesses
    """Autoregressive processes of the weights."""
    acceleration_variances: tuple[float, float]
    """Variances of the accelerations of rotation [rad2] and shift."""
    variance: float
    """Variance of a normalised image coordinate about the model."""
    pairs: Integers
    """(E, 2) neighbouring points."""
    distance: Floats
    """(E,) mean distance of each pair."""
    distance_variance: Floats
    """(E,) variance of that distance over the frames."""
    covariance: tuple[Floats, Floats, Floats]
    """(F, 6 + M, 6 + M) of each frame's unknowns, with those of the next frame and of the next but one."""
    cost: float = np.inf
    """Minus the log-probability of the tracks, up to a constant."""
    correlated_frames: float = 1.0
    """Number of frames over which departures from a distance are correlated; so many count as one observation."""
    settings: PerspectiveModelSettings = field(default_factory=PerspectiveModelSettings)
    """Tuned constants of the model."""

    @property
    def distance_weight(self) -> float:
        """Weight of a distance, by which all distances count as much as one number per point and frame (the depth).

        Distances of neighbours are correlated; counted as independent observations they would outweigh the tracks.
        """
        return float(min(1.0, self.mean.shape[1] / max(len(self.pairs), 1)) / self.correlated_frames)

    @property
    def stretch(self) -> float:
        """Median relative standard deviation of the distances between neighbours; 0 without pairs."""
        return float(np.median(np.sqrt(self.distance_variance) / self.distance)) if len(self.pairs) else 0.0

    @property
    def row(self) -> Floats:
        """(F, 1 + M) weights of the mean shape and the modes."""
        return np.concatenate([np.ones((len(self.weights), 1)), self.weights], 1)

    @property
    def shapes(self) -> Floats:
        """(F, 3, P) shapes in the object's frame."""
        return np.asarray(self.mean + np.einsum("fm,mip->fip", self.weights, self.modes))

    @property
    def points(self) -> Floats:
        """(F, 3, P) points in camera axes."""
        return np.asarray(self.rotation @ self.shapes + self.shift[:, :, None])


def initial_model(
    rotation: Floats,
    shift: Floats,
    shapes: Floats,
    modes: int,
    noise: float,
    pairs: Integers,
    settings: PerspectiveModelSettings = PerspectiveModelSettings(),
) -> PerspectiveModel:
    """Create a model from poses and shapes.

    Args:
        rotation: (F, 3, 3) camera from object.
        shift: (F, 3) object's origin in camera axes.
        shapes: (F, 3, P) in the object's frame.
        modes: Largest number of modes.
        noise: Initial standard deviation of a normalised image coordinate.
        pairs: (E, 2) neighbouring points.
        settings: Tuned constants of the model.
    """
    least_acceleration = settings.least_acceleration_sd**2
    middle = shapes.mean(2)
    shift = shift + np.einsum("fij,fj->fi", rotation, middle)
    shapes = shapes - middle[:, :, None]
    frames, _, points = shapes.shape
    mean = shapes.mean(0)
    size = float(np.sqrt((mean**2).mean()))
    shapes, mean, shift = shapes / size, mean / size, shift / size
    u, d, vt = np.linalg.svd((shapes - mean).reshape(frames, -1), full_matrices=False)
    modes = min(modes, len(d))
    weights = u[:, :modes] * d[:modes] / np.sqrt(points)
    unknowns = MOTION + modes
    lengths = lengths_of(shapes, pairs)[0]
    distance = lengths.mean(0)
    changes = np.diff(shift, 2, axis=0)
    return PerspectiveModel(
        rotation=rotation, shift=shift, mean=mean, weights=weights,
        modes=(vt[:modes] * np.sqrt(points)).reshape(modes, 3, points),
        processes=initial_processes(weights, _LEAST_VARIANCE),
        acceleration_variances=(
            max(float((accelerations(rotation) ** 2).mean()), least_acceleration),
            max(float((changes**2).mean()), least_acceleration),
        ),
        variance=noise**2, pairs=pairs, distance=distance,
        distance_variance=((lengths - distance) ** 2).mean(0) + (settings.least_stretch * distance) ** 2,
        covariance=(np.zeros((frames, unknowns, unknowns)),) * 3, settings=settings,
    )  # fmt: skip


def lengths_of(shapes: Floats, pairs: Integers) -> tuple[Floats, Floats]:
    """Compute the distances of neighbours (F, E) and their directions (F, 3, E)."""
    apart = shapes[:, :, pairs[:, 0]] - shapes[:, :, pairs[:, 1]]
    length = np.linalg.norm(apart, axis=1)
    return length, apart / np.maximum(length, _LEAST_LENGTH)[:, None]


def image_residuals(model: PerspectiveModel, tracks: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Compute residuals (F, 2, P) and the image's derivatives (F, 2, 3, P) by the points in camera axes."""
    points = model.points
    image = points[:, :2] / points[:, 2:]
    by_point = np.zeros((len(points), 2, 3, points.shape[2]))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1
    by_point[:, :, 2] = -image
    return (tracks - image) * seen[:, None], by_point * (seen / points[:, 2])[:, None, None]


def residuals_and_jacobians(model: PerspectiveModel, tracks: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Compute residuals (F, 2, P) and the model's derivatives (F, 2, P, 6 + M) by left rotation, shift and weights."""
    residual, by_point = image_residuals(model, tracks, seen)
    frames, _, points = tracks.shape
    carried = model.rotation @ model.shapes
    by_unknown = np.zeros((frames, 3, points, MOTION + len(model.modes)))
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        by_unknown[:, j, :, axis], by_unknown[:, i, :, axis] = carried[:, i], -carried[:, j]
        by_unknown[:, axis, :, 3 + axis] = 1
    by_weight = model.rotation @ model.modes.transpose(1, 2, 0).reshape(3, -1)
    by_unknown[..., MOTION:] = by_weight.reshape(frames, 3, points, -1)
    jacobian = by_point[:, :, 0, :, None] * by_unknown[:, None, 0]
    for k in (1, 2):
        jacobian += by_point[:, :, k, :, None] * by_unknown[:, None, k]
    return residual, jacobian


def distance_jacobians(model: PerspectiveModel) -> tuple[Floats, Floats]:
    """Compute mean minus current distances (F, E) and the distances' derivatives (F, E, M) by the weights."""
    length, direction = lengths_of(model.shapes, model.pairs)
    apart = model.modes[:, :, model.pairs[:, 0]] - model.modes[:, :, model.pairs[:, 1]]
    by_weight = np.matmul(direction.transpose(2, 0, 1), apart.transpose(2, 1, 0)).transpose(1, 0, 2)
    return model.distance - length, by_weight


def negative_log_probability(model: PerspectiveModel, tracks: Floats, seen: Floats) -> float:
    """Compute minus the log-probability of tracks and parameters together, up to a constant."""
    if float(model.points[:, 2].min()) <= 0:
        return np.inf
    residual = image_residuals(model, tracks, seen)[0]
    missing = model.distance - lengths_of(model.shapes, model.pairs)[0]
    frames = len(tracks)
    turns, changes = accelerations(model.rotation), np.diff(model.shift, 2, axis=0)
    total = float((residual**2).sum()) / model.variance + 2 * float(seen.sum()) * np.log(model.variance)
    of_distances = float((missing**2 / model.distance_variance).sum() + frames * np.log(model.distance_variance).sum())
    total += model.distance_weight * of_distances
    for values, variance in zip((turns, changes), model.acceleration_variances, strict=True):
        total += float((values**2).sum()) / variance + values.size * np.log(variance)
    return float(0.5 * total + model.processes.cost(model.weights))


def frame_equations(model: PerspectiveModel, tracks: Floats, seen: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Compute the normal equations of all frames, given the shapes, in the form of `solve_banded`."""
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    frames, unknowns = len(tracks), jacobian.shape[-1]
    flat = jacobian.reshape(frames, -1, unknowns)
    diagonal = np.swapaxes(flat, 1, 2) @ flat / model.variance
    right = (np.swapaxes(flat, 1, 2) @ residual.reshape(frames, -1, 1))[..., 0] / model.variance
    missing, by_weight = distance_jacobians(model)
    weighed = by_weight * (model.distance_weight / model.distance_variance)[:, None]
    diagonal[:, MOTION:, MOTION:] += np.swapaxes(weighed, 1, 2) @ by_weight
    right[:, MOTION:] += products(np.swapaxes(weighed, 1, 2), missing)
    diagonal[:, range(MOTION), range(MOTION)] += 1e-8
    first, second = np.zeros_like(diagonal), np.zeros_like(diagonal)
    add_acceleration_penalty(diagonal, first, second, right, model.rotation, 1 / model.acceleration_variances[0])
    _add_smooth_shift(diagonal, first, second, right, model)
    model.processes.add(diagonal, first, second, right, model.weights, MOTION)
    return diagonal, first, second, right


def solve_frames(model: PerspectiveModel, tracks: Floats, seen: Floats) -> None:
    """Do one Gauss-Newton step of all frames together, halved until it helps; set covariance and cost."""
    step, *covariance, determinant = solve_banded(*frame_equations(model, tracks, seen))
    model.covariance = (covariance[0], covariance[1], covariance[2])
    before = negative_log_probability(model, tracks, seen)
    model.cost = before + 0.5 * determinant
    start = model.rotation, model.shift, model.weights
    share = min(1.0, model.settings.longest_turn / max(float(np.abs(step[:, :3]).max()), 1e-300))
    for _ in range(model.settings.halvings):
        model.rotation = rotations.exp(share * step[:, :3]) @ start[0]
        model.shift = start[1] + share * step[:, 3:MOTION]
        model.weights = start[2] + share * step[:, MOTION:]
        if negative_log_probability(model, tracks, seen) <= before:
            return
        share /= 2
    model.rotation, model.shift, model.weights = start


def _add_smooth_shift(diagonal: Floats, first: Floats, second: Floats, right: Floats, model: PerspectiveModel) -> None:
    """Add the squared second differences of the shift, over their variance, to the normal equations."""
    changes, precision, own = np.diff(model.shift, 2, axis=0), 1 / model.acceleration_variances[1], np.arange(3, MOTION)
    by = (1.0, -2.0, 1.0)
    for k in range(3):
        span = slice(k, len(model.shift) - 2 + k)
        diagonal[span, own, own] += precision * by[k] ** 2
        right[span, 3:MOTION] -= precision * by[k] * changes
    first[:-2, own, own] += precision * by[0] * by[1]
    first[1:-1, own, own] += precision * by[1] * by[2]
    second[:-2, own, own] += precision * by[0] * by[2]


def basis_equations(model: PerspectiveModel, tracks: Floats, seen: Floats, *, certain: bool = False) -> ShapeEquations:
    """Compute the equations of mean shape and modes; `certain` ignores the uncertainty of the frames."""
    residual, by_point = image_residuals(model, tracks, seen)
    by_shape = np.einsum("fkip,fij->fkjp", by_point, model.rotation)
    shapes = model.shapes
    wanted = residual + np.einsum("fkjp,fjp->fkp", by_shape, shapes)
    row = model.row
    square, moved = row[:, :, None] * row[:, None], _motion_products(model)
    if certain:
        moved = np.zeros_like(moved)
    else:
        square[:, 1:, 1:] += model.covariance[0][:, MOTION:, MOTION:]
    direction = lengths_of(shapes, model.pairs)[1]
    sharp, tight = 1 / np.sqrt(model.variance), np.sqrt(model.distance_weight / model.distance_variance)
    return shape_equations(
        row, square, by_shape * sharp, wanted * sharp, moved, model.pairs, direction * tight, model.distance * tight
    )


def solve_shapes(model: PerspectiveModel, tracks: Floats, seen: Floats) -> None:
    """Solve for the mean shape and the modes, given the estimates of the frames, and restore the gauge."""
    basis = np.concatenate([model.mean[None], model.modes])
    basis = solve_shape_equations(basis_equations(model, tracks, seen), basis)
    # The uncertainty of the weights counts here and not in `negative_log_probability`, which may thus rise slightly.
    enough, start = negative_log_probability(model, tracks, seen) + float(seen.sum()), (model.mean, model.modes)
    for halving in range(model.settings.halvings):
        share = 0.5**halving
        model.mean = (1 - share) * start[0] + share * basis[0]
        model.modes = (1 - share) * start[1] + share * basis[1:]
        if negative_log_probability(model, tracks, seen) <= enough:
            break
    else:
        model.mean, model.modes = start
    remove_small_modes(model)
    set_gauge(model)


def remove_small_modes(model: PerspectiveModel) -> None:
    """Remove modes of negligible size: nothing constrains their weights, which would grow without limit."""
    own = np.einsum("fmm->m", model.covariance[0][:, MOTION:, MOTION:]) / len(model.weights)
    moved = ((model.weights**2).mean(0) + own) * (model.modes**2).mean((1, 2))
    kept = np.flatnonzero(moved > model.settings.least_mode_size**2)
    unknowns = np.concatenate([np.arange(MOTION), MOTION + kept])
    model.modes, model.weights = model.modes[kept], model.weights[:, kept]
    model.processes = model.processes.among(kept)
    here, near, far = (part[:, unknowns][:, :, unknowns] for part in model.covariance)
    model.covariance = (here, near, far)


def _motion_products(model: PerspectiveModel) -> Floats:
    """Compute expected products (F, 1 + M, 3, P) of the errors of the weights and of the points' motion.

    A growing size and an increasing distance are each poorly determined, but together they explain the tracks. Without
    these products such modes would shrink, as if the two errors were independent.
    """
    together = np.pad(model.covariance[0][:, MOTION:, :MOTION], ((0, 0), (1, 0), (0, 0)))
    carried = (model.rotation @ model.shapes)[:, None]
    moved = np.cross(together[..., :3, None], carried, axis=2) + together[..., 3:, None]
    return np.asarray(np.swapaxes(model.rotation, 1, 2)[:, None] @ moved)


def set_gauge(model: PerspectiveModel) -> None:
    """Centre and scale the object, and move motions of the mean shape, to first order, from the modes to the poses."""
    middle = np.concatenate([model.mean[None], model.modes]).mean(2)
    model.shift = model.shift + np.einsum("fij,fj->fi", model.rotation, model.row @ middle)
    model.mean, model.modes = model.mean - middle[0][:, None], model.modes - middle[1:, :, None]
    inertia = (model.mean**2).sum() * np.eye(3) - model.mean @ model.mean.T
    moments = np.cross(model.mean.T[None], np.swapaxes(model.modes, 1, 2)).sum(1)
    turns = np.linalg.solve(inertia, moments.T).T
    model.modes = model.modes - np.cross(turns[:, None], model.mean.T[None]).swapaxes(1, 2)
    model.rotation = model.rotation @ rotations.exp(model.weights @ turns)
    size = float(np.sqrt((model.mean**2).mean()))
    model.mean, model.modes, model.shift = model.mean / size, model.modes / size, model.shift / size
    model.distance, model.distance_variance = model.distance / size, model.distance_variance / size**2


def solve_variances(model: PerspectiveModel, tracks: Floats, seen: Floats, least_noise: float) -> None:
    """Estimate noise, distances and their variances, the weights' processes and the acceleration variances."""
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    frames = len(tracks)
    flat = jacobian.reshape(frames, -1, jacobian.shape[-1])
    uncertainty = float(np.einsum("fde,fde->", np.swapaxes(flat, 1, 2) @ flat, model.covariance[0]))
    model.variance = max((float((residual**2).sum()) + uncertainty) / (2 * float(seen.sum())), least_noise**2)
    of_weights = tuple(part[:, MOTION:, MOTION:] for part in model.covariance)
    missing, by_weight = distance_jacobians(model)
    model.distance = model.distance - missing.mean(0)
    squares = (missing - missing.mean(0)) ** 2 + np.einsum("fem,fem->fe", by_weight @ of_weights[0], by_weight)
    common = float(np.median(squares.mean(0) / model.distance**2)) if squares.size else 0.0
    prior = model.settings.stretch_frames
    own = prior * common * model.distance**2 + squares.sum(0)
    model.distance_variance = own / (prior + frames) + (model.settings.least_stretch * model.distance) ** 2
    model.processes = estimated_processes(model.weights, (of_weights[0], of_weights[1], of_weights[2]))
    turns, changes = accelerations(model.rotation), np.diff(model.shift, 2, axis=0)
    model.acceleration_variances = (
        max(float((turns**2).mean()), model.settings.least_acceleration_sd**2),
        max(float((changes**2).mean()), model.settings.least_acceleration_sd**2),
    )


def refine(model: PerspectiveModel, tracks: Floats, seen: Floats, rounds: int, least_noise: float) -> None:
    """Do rounds of all three steps, then the first again, so that covariance and cost belong to the final estimate.

    Args:
        model: Changed in place.
        tracks: (F, 2, P) normalised image coordinates, with arbitrary values where not seen.
        seen: (F, P) 1 where seen, else 0.
        rounds: Number of rounds.
        least_noise: Least standard deviation of a normalised image coordinate.
    """
    for _ in range(rounds):
        solve_frames(model, tracks, seen)
        solve_shapes(model, tracks, seen)
        solve_variances(model, tracks, seen, least_noise)
    solve_frames(model, tracks, seen)
