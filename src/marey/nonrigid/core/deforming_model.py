"""A deforming shape before one camera or more as a Gaussian model, fitted by expectation and maximisation.

Frame f shows P R_f (M + c_f1 B_1 + ...) + t_f with white noise; P is the first two rows of the identity for one camera,
and the rows of all of them for several that stand fixed to each other. The weights c are processes that each remember
two frames (autoregressive, learned); turns of the camera change their rate at random by a learned amount. Every
frame's turn, shift and weights are solved together over the whole sequence by Gauss-Newton, with their covariance; the
shapes then point by point; then the noise and the processes ([Torresani2008], there with a memory of one frame and
without the camera in the same equations).
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations
from marey.nonrigid.core import kept_lengths
from marey.nonrigid.core.block_banded import solve_banded
from marey.nonrigid.core.completion import singular_vectors
from marey.nonrigid.core.kept_lengths import KeptLengths
from marey.nonrigid.core.rotation_paths import acceleration_jacobians, accelerations, add_steadiness

ONE_CAMERA = np.eye(2, 3)
TURN = 3
"""Unknowns of a frame that come first; its shifts follow, two a camera, then the weights."""
LONGEST_TURN = 0.3
FIRST_MEMORY = (1.9, -0.95)
STEADIEST = 1e-6
"""Least standard deviation of the camera's acceleration that is believed [rad]."""
LEAST = 1e-12
PRICE_A_POINT = 1.5
"""Half of a number for each coordinate of a point in a mode, see `basis_cost`."""


@dataclass
class DeformingModel:
    """The model and what is known of its sequence; changed by the steps below."""

    rotation: Floats
    """(F, 3, 3)."""
    shift: Floats
    """(F, 2C)."""
    mean: Floats
    """(3, P)."""
    modes: Floats
    """(M, 3, P)."""
    weights: Floats
    """(F, M)."""
    spread: Floats
    """(M,) variance of the weights."""
    memory: Floats
    """(M, 2) share of the last weight and of the one before."""
    surprise: Floats
    """(M,) variance of what the memory does not foretell."""
    unsteadiness: float
    """Variance of the camera's acceleration [rad2]."""
    variance: float
    """Of a coordinate of the tracks about the model."""
    covariance: tuple[Floats, Floats, Floats]
    """(F, D, D) of each frame's unknowns, and with the next and the next but one; D = 3 + 2C + M."""
    projection: Floats
    """(2C, 3) P, what the cameras show of the first camera's axes."""
    cost: float = np.inf
    """Minus the logarithm of the tracks' probability, up to a constant."""
    lengths: KeptLengths | None = None
    """Distances that are held too, if any."""

    @property
    def shapes(self) -> Floats:
        """(F, 3, P)."""
        moved = self.weights @ self.modes.reshape(len(self.modes), self.mean.size)
        return np.asarray(self.mean + moved.reshape(-1, *self.mean.shape))

    @property
    def first_weight(self) -> int:
        """Place of the first weight among a frame's unknowns."""
        return TURN + len(self.projection)

    def mode_sizes(self) -> Floats:
        """Give what each mode does (M,), root mean square over frames and points."""
        points = self.mean.shape[1]
        return np.asarray(np.sqrt((self.weights**2).mean(0) * (self.modes**2).sum((1, 2)) / points))


def begin(
    tracks: Floats,
    seen: Floats,
    rotation: Floats,
    shapes: Floats,
    modes: int,
    noise: float,
    projection: Floats = ONE_CAMERA,
) -> DeformingModel:
    """Start from rotations and shapes.

    Args:
        tracks: (F, 2C, P), of any finite value where not seen.
        seen: (F, P), or (F, C, P) for several cameras.
        rotation: (F, 3, 3) first camera from object.
        shapes: (F, 3, P).
        modes: their number at most.
        noise: a first guess of its standard deviation, in the tracks' unit.
        projection: (2C, 3).
    """
    shapes = shapes - shapes.mean(2, keepdims=True)
    frames, _, points = shapes.shape
    mean = shapes.mean(0)
    u, d, vt = singular_vectors((shapes - mean).reshape(frames, -1))
    modes = min(modes, len(d))
    weights = u[:, :modes] * d[:modes] / np.sqrt(points)
    memory = np.tile(FIRST_MEMORY, (modes, 1))
    foretold = memory[:, 0] * weights[1:-1] + memory[:, 1] * weights[:-2]
    floor = LEAST * float(np.mean(mean**2))
    unknowns = TURN + len(projection) + modes
    model = DeformingModel(
        rotation=rotation, projection=projection, shift=np.zeros((frames, len(projection))),
        mean=mean, weights=weights, memory=memory,
        modes=(vt[:modes] * np.sqrt(points)).reshape(modes, 3, points), spread=(weights**2).mean(0) + floor,
        surprise=((weights[2:] - foretold) ** 2).mean(0) + floor,
        unsteadiness=max(float((accelerations(rotation) ** 2).mean()), STEADIEST**2),
        variance=noise**2, covariance=(np.zeros((frames, unknowns, unknowns)),) * 3,
    )  # fmt: skip
    rows = by_row(seen)
    model.shift = ((tracks - projection @ rotation @ shapes) * rows).sum(2) / np.maximum(rows.sum(2), 1)
    return model


def by_row(seen: Floats) -> Floats:
    """Say of both coordinates (F, 2C, P) what is said of the points (F, P) or (F, C, P)."""
    return np.repeat(seen.reshape(len(seen), -1, seen.shape[-1]), 2, axis=1)


def residuals_and_jacobians(model: DeformingModel, tracks: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Give the residuals (F, 2C, P) and the model's derivative (F, 2C, P, D) by left turn, shift and weights."""
    frames, count, points = tracks.shape
    known = by_row(seen)
    carried = model.rotation @ model.shapes
    residual = (tracks - model.projection @ carried - model.shift[:, :, None]) * known
    jacobian = np.zeros((frames, count, points, model.first_weight + len(model.modes)))
    for row, sight in enumerate(model.projection):
        # a turn d moves the point y by d x y, and what a row p shows of it by p . (d x y) = d . (y x p)
        jacobian[:, row, :, :TURN] = np.cross(np.swapaxes(carried, 1, 2), sight)
        jacobian[:, row, :, TURN + row] = 1
    by_weight = model.projection @ model.rotation @ model.modes.transpose(1, 2, 0).reshape(3, -1)
    jacobian[..., model.first_weight :] = by_weight.reshape(frames, count, points, -1)
    if not known.all():
        jacobian *= known[..., None]
    return residual, jacobian


def solve_frames(model: DeformingModel, tracks: Floats, seen: Floats) -> None:
    """Do one Gauss-Newton step of all frames together; sets covariance and cost."""
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    frames, unknowns = len(tracks), jacobian.shape[-1]
    flat = jacobian.reshape(frames, -1, unknowns)
    turned = np.swapaxes(flat, 1, 2)
    diagonal = turned @ flat / model.variance
    right = (turned @ residual.reshape(frames, -1, 1))[..., 0] / model.variance
    # of what nothing is seen, a camera's shift too, nothing is learned, and the equations stay solvable
    diagonal[:, range(model.first_weight), range(model.first_weight)] += 1e-8
    first, second = np.zeros_like(diagonal), np.zeros_like(diagonal)
    add_steadiness(diagonal, first, second, right, model.rotation, 1 / model.unsteadiness)
    surprise = _add_memory(model, diagonal, first, second, right)
    if model.lengths is not None:
        normal, side = kept_lengths.weight_equations(model.lengths, model.shapes, model.modes)
        diagonal[:, model.first_weight :, model.first_weight :] += normal
        right[:, model.first_weight :] += side
    step, *covariance, determinant = solve_banded(diagonal, first, second, right)
    model.covariance = (covariance[0], covariance[1], covariance[2])
    model.cost = 0.5 * (
        float((residual**2).sum()) / model.variance
        + float((accelerations(model.rotation) ** 2).sum()) / model.unsteadiness
        + surprise + determinant + 2 * float(seen.sum()) * np.log(model.variance)
        + 3 * (frames - 2) * np.log(model.unsteadiness)
        + float((frames - 2) * np.log(model.surprise).sum() + 2 * np.log(model.spread).sum())
    ) + (0.0 if model.lengths is None else kept_lengths.cost(model.lengths, model.shapes))  # fmt: skip
    share = min(1.0, LONGEST_TURN / max(float(np.abs(step[:, :3]).max()), 1e-300))
    model.rotation = rotations.exp(share * step[:, :3]) @ model.rotation
    model.shift = model.shift + share * step[:, TURN : model.first_weight]
    model.weights = model.weights + share * step[:, model.first_weight :]


def _add_memory(model: DeformingModel, diagonal: Floats, first: Floats, second: Floats, right: Floats) -> float:
    """Add the weights' processes to the normal equations; give their squared surprises over the variances."""
    frames, own = len(right), np.arange(model.first_weight, right.shape[1])
    left = model.weights[2:] - model.memory[:, 0] * model.weights[1:-1] - model.memory[:, 1] * model.weights[:-2]
    precision = 1 / model.surprise
    by = (-model.memory[:, 1], -model.memory[:, 0], np.ones(len(own)))
    for k in range(3):
        span = slice(k, frames - 2 + k)
        diagonal[span, own, own] += precision * by[k] ** 2
        right[span, model.first_weight :] -= precision * by[k] * left
    first[:-2, own, own] += precision * by[0] * by[1]
    first[1:-1, own, own] += precision * by[1] * by[2]
    second[:-2, own, own] += precision * by[0] * by[2]
    diagonal[:2, own, own] += 1 / model.spread
    right[:2, model.first_weight :] -= model.weights[:2] / model.spread
    return float((left**2 * precision).sum() + (model.weights[:2] ** 2 / model.spread).sum())


def solve_shapes(model: DeformingModel, tracks: Floats, seen: Floats) -> None:
    """Solve for the mean shape and the modes of every point, given what is known of the frames."""
    points = tracks.shape[2]
    row, square = _known_weights(model)
    rows = model.projection @ model.rotation
    blocks = _seen_blocks(model, seen)
    left = (tracks - model.shift[:, :, None]) * by_row(seen)
    side = np.swapaxes(rows, 1, 2) @ left / model.variance
    if model.lengths is not None:
        # Both ends of a pair move at once: each answers for twice its share, so that together they do not overshoot.
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


def _known_weights(model: DeformingModel) -> tuple[Floats, Floats]:
    """Give 1 and the weights of every frame (F, 1 + M), and their expected products (F, 1 + M, 1 + M)."""
    row = np.concatenate([np.ones((len(model.weights), 1)), model.weights], 1)
    square = row[:, :, None] * row[:, None]
    square[:, 1:, 1:] += model.covariance[0][:, model.first_weight :, model.first_weight :]
    return row, square


def _seen_blocks(model: DeformingModel, seen: Floats) -> Floats:
    """Give what the tracks tell of every point's place (F, P, 3, 3), as inverse covariance."""
    cameras = seen.reshape(len(seen), -1, seen.shape[-1]) / model.variance
    blocks = np.zeros((len(seen), seen.shape[-1], 3, 3))
    for camera in range(cameras.shape[1]):
        rows = model.projection[2 * camera : 2 * camera + 2] @ model.rotation
        blocks += (np.swapaxes(rows, 1, 2) @ rows)[:, None] * cameras[:, camera, :, None, None]
    return blocks


def _point_normals(square: Floats, blocks: Floats) -> Floats:
    """Give every point's normal matrix (P, 3 + 3M, 3 + 3M) of its mean place and modes."""
    frames, count, _ = square.shape
    points = blocks.shape[1]
    normal = square.reshape(frames, -1).T @ blocks.reshape(frames, -1)
    return normal.reshape(count, count, points, 3, 3).transpose(2, 0, 3, 1, 4).reshape(points, 3 * count, 3 * count)


def shape_variance(model: DeformingModel, seen: Floats) -> Floats:
    """Give the variance (F, 3, P) of the shapes: of the weights, given the modes, and of the modes, given the weights.

    Coordinates of the modes are believed to be of size 1 beforehand.
    """
    of_weights = model.covariance[0][:, model.first_weight :, model.first_weight :]
    by_weight = np.moveaxis(model.modes, 0, 2).reshape(model.mean.size, len(model.modes))
    first = ((by_weight @ of_weights) * by_weight).sum(2).reshape(len(seen), *model.mean.shape)
    _, square = _known_weights(model)
    blocks = _seen_blocks(model, seen)
    if model.lengths is not None:
        blocks += kept_lengths.point_equations(model.lengths, model.shapes)[0]
    normal = _point_normals(square, blocks)
    normal[:, range(normal.shape[1]), range(normal.shape[1])] += 1
    points, count = len(normal), square.shape[1]
    inverse = np.linalg.inv(normal).reshape(points, count, 3, count, 3)
    axes = np.einsum("paibi->iabp", inverse).reshape(3, count * count, points)
    return np.asarray(first + np.swapaxes(square.reshape(len(seen), -1) @ axes, 0, 1))


def solve_processes(model: DeformingModel, tracks: Floats, seen: Floats, least_noise: float) -> None:
    """Estimate the noise, the weights' processes and the camera's unsteadiness anew."""
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    frames = len(tracks)
    flat = jacobian.reshape(frames, -1, jacobian.shape[-1])
    doubt = float(np.einsum("fde,fde->", np.swapaxes(flat, 1, 2) @ flat, model.covariance[0]))
    model.variance = max((float((residual**2).sum()) + doubt) / (2 * float(seen.sum())), least_noise**2)
    here, near, far = (
        np.einsum("fmm->fm", part[:, model.first_weight :, model.first_weight :]) for part in model.covariance
    )
    c = model.weights
    now, last, before = ((c[k:][: frames - 2] ** 2 + here[k:][: frames - 2]).sum(0) for k in (2, 1, 0))
    now_last, last_before = (c[2:] * c[1:-1] + near[1:-1]).sum(0), (c[1:-1] * c[:-2] + near[:-2]).sum(0)
    now_before = (c[2:] * c[:-2] + far[:-2]).sum(0)
    normal = np.moveaxis(np.array([[last, last_before], [last_before, before]]), -1, 0)
    normal = normal + 1e-12 * (last + before)[:, None, None] * np.eye(2)
    right = np.stack([now_last, now_before], 1)
    model.memory = np.linalg.solve(normal, right[..., None])[..., 0]
    left = now - 2 * (model.memory * right).sum(1) + np.einsum("mi,mij,mj->m", model.memory, normal, model.memory)
    model.surprise = np.maximum(left / (frames - 2), 1e-16 * now / frames + 1e-300)
    model.spread = (c**2 + here).mean(0)
    model.unsteadiness = max(_unsteadiness(model), STEADIEST**2)
    if model.lengths is not None:
        _, along = kept_lengths.departures(model.lengths, model.shapes)
        by_weight = kept_lengths.derivatives(model.lengths, along, model.modes)
        of_weights = model.covariance[0][:, model.first_weight :, model.first_weight :]
        doubted = ((by_weight @ of_weights) * by_weight).sum(2).mean(0)
        model.lengths = kept_lengths.learned(model.lengths.pairs, model.shapes, doubted)


def _unsteadiness(model: DeformingModel) -> float:
    """Give the mean square of the camera's acceleration, what is not known of it included."""
    jacobians = acceleration_jacobians(model.rotation)
    frames = len(model.rotation)
    total = float((accelerations(model.rotation) ** 2).sum())
    for i in range(3):
        for j in range(i, 3):
            part = model.covariance[j - i][i : frames - 2 + i, :3, :3]
            total += (1 + (j > i)) * float(np.einsum("fij,fjk,fik->", jacobians[i], part, jacobians[j], optimize=True))
    return total / (3 * (frames - 2))


def improve(model: DeformingModel, tracks: Floats, seen: Floats, rounds: int, least_noise: float = 0.0) -> None:
    """Do rounds of all three steps, and once more the first, so that covariance and cost are those of the end."""
    floor = max(least_noise, 1e-6 * float(np.sqrt(np.mean(model.mean**2))))
    for _ in range(rounds):
        solve_frames(model, tracks, seen)
        solve_shapes(model, tracks, seen)
        solve_processes(model, tracks, seen, floor)
    solve_frames(model, tracks, seen)


def keep_modes(model: DeformingModel, kept: Mask) -> None:
    """Leave out all modes but those kept (M,)."""
    unknowns = np.concatenate([np.ones(model.first_weight, bool), kept])
    here, near, far = (part[:, unknowns][:, :, unknowns] for part in model.covariance)
    model.covariance = (here, near, far)
    model.modes, model.weights, model.memory = model.modes[kept], model.weights[:, kept], model.memory[kept]
    model.spread, model.surprise = model.spread[kept], model.surprise[kept]


def basis_cost(model: DeformingModel) -> float:
    """Give minus the logarithm of what the modes' freedom costs the tracks' probability, up to a constant.

    Each coordinate of a mode of root mean square 1 is believed to be of size 1 beforehand; one camera tells two of
    three coordinates a frame, so the tracks narrow it by the square root of 1 + 2 sum(c^2) / (3 noise^2) (Laplace).
    """
    share = float((model.projection**2).sum()) / 3
    weights = model.weights - model.weights.mean(0)
    left = np.einsum("fm,mip->fip", weights, model.modes).reshape(len(weights), -1)
    square = left @ left.T if len(left) < left.shape[1] else left.T @ left
    size = np.maximum(np.linalg.eigvalsh(square)[::-1][: len(model.modes)], 0)
    points = model.mean.shape[1]
    return float(PRICE_A_POINT * points * np.log1p(share * size / (points * model.variance)).sum())
