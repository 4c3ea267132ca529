"""A deforming shape before one camera in full perspective as a Gaussian model, fitted by expectation and maximisation.

Frame f shows X = R_f (M + c_f1 B_1 + ...) + t_f at (X_1, X_2) / X_3 with white noise. As in `deforming_model` the
weights remember two frames and the camera's turn changes its rate at random; here the shift is in space and changes
its rate at random too, and neighbours keep their distance up to a standard deviation of each pair's own, which the
sequence itself tells: small on skin and cloth, large across a joint.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.geometry import rotations
from marey.nonrigid.core.block_banded import solve_banded
from marey.nonrigid.core.rotation_paths import accelerations, add_steadiness
from marey.nonrigid.one_camera.shape_equations import ShapeEquations, shape_equations, solve_shape_equations
from marey.nonrigid.one_camera.weight_processes import WeightProcesses, processes_of

MOTION = 6
"""Unknowns of a frame before its weights: three of the turn, three of the shift."""
LONGEST_TURN = 0.2
STEADIEST = 1e-5
"""Least standard deviation of the camera's acceleration that is believed [rad, and shares of the object's size]."""
STRETCH_FREEDOM = 4.0
"""Frames that the pairs' common standard deviation is worth beside a pair's own frames."""
LEAST_STRETCH = 0.005
"""Least standard deviation of a pair's distance, as a share of it."""
HALVINGS = 6
SLIGHTEST = 1e-5
"""A mode that moves the points by less than this share of the object's size is given up."""


@dataclass
class PerspectiveModel:
    """The model and what is known of its sequence, in normalised image coordinates; changed by the steps below."""

    rotation: Floats
    """(F, 3, 3) camera from object."""
    shift: Floats
    """(F, 3) of the object's origin before the camera; the mean shape's root mean square is 1."""
    mean: Floats
    """(3, P)."""
    modes: Floats
    """(M, 3, P)."""
    weights: Floats
    """(F, M)."""
    processes: WeightProcesses
    unsteadiness: tuple[float, float]
    """Variances of the accelerations of turn [rad2] and shift."""
    variance: float
    """Of a normalised image coordinate about the model."""
    pairs: Integers
    """(E, 2) neighbours."""
    distance: Floats
    """(E,)."""
    stretch: Floats
    """(E,) variance of the distance."""
    covariance: tuple[Floats, Floats, Floats]
    """(F, 6 + M, 6 + M) of each frame's unknowns, and with the next and the next but one."""
    cost: float = np.inf
    """Minus the logarithm of the tracks' probability, up to a constant."""
    alike: float = 1.0
    """Frames over which a distance changes alike: so many say as much as one."""

    @property
    def share(self) -> float:
        """What a distance counts for: together as much as one number a point and frame, the depth that is looked for.

        Distances of neighbours hang together; counted as so many observations they would outweigh the tracks.
        """
        return min(1.0, self.mean.shape[1] / max(len(self.pairs), 1)) / self.alike

    @property
    def change(self) -> float:
        """How much distances between neighbours change: median of their deviations over them, 0 without any."""
        return float(np.median(np.sqrt(self.stretch) / self.distance)) if len(self.pairs) else 0.0

    @property
    def row(self) -> Floats:
        """(F, 1 + M) weights of the mean shape and the modes."""
        return np.concatenate([np.ones((len(self.weights), 1)), self.weights], 1)

    @property
    def shapes(self) -> Floats:
        """(F, 3, P)."""
        return np.asarray(self.mean + np.einsum("fm,mip->fip", self.weights, self.modes))

    @property
    def points(self) -> Floats:
        """(F, 3, P) before the camera."""
        return np.asarray(self.rotation @ self.shapes + self.shift[:, :, None])


def begin(
    rotation: Floats, shift: Floats, shapes: Floats, modes: int, noise: float, pairs: Integers
) -> PerspectiveModel:
    """Start from poses and shapes (F, 3, P) in the object's frame; the noise is in normalised image coordinates."""
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
    jerks = np.diff(shift, 2, axis=0)
    return PerspectiveModel(
        rotation=rotation, shift=shift, mean=mean, weights=weights,
        modes=(vt[:modes] * np.sqrt(points)).reshape(modes, 3, points), processes=processes_of(weights, 1e-12),
        unsteadiness=(
            max(float((accelerations(rotation) ** 2).mean()), STEADIEST**2),
            max(float((jerks**2).mean()), STEADIEST**2),
        ),
        variance=noise**2, pairs=pairs, distance=distance,
        stretch=((lengths - distance) ** 2).mean(0) + (LEAST_STRETCH * distance) ** 2,
        covariance=(np.zeros((frames, unknowns, unknowns)),) * 3,
    )  # fmt: skip


def lengths_of(shapes: Floats, pairs: Integers) -> tuple[Floats, Floats]:
    """Give the distances of neighbours (F, E) and their directions (F, 3, E)."""
    apart = shapes[:, :, pairs[:, 0]] - shapes[:, :, pairs[:, 1]]
    length = np.linalg.norm(apart, axis=1)
    return length, apart / np.maximum(length, 1e-12)[:, None]


def seen_from(model: PerspectiveModel, tracks: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Give the residuals (F, 2, P) and the image's derivative (F, 2, 3, P) by the point before the camera."""
    points = model.points
    image = points[:, :2] / points[:, 2:]
    by_point = np.zeros((len(points), 2, 3, points.shape[2]))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1
    by_point[:, :, 2] = -image
    return (tracks - image) * seen[:, None], by_point * (seen / points[:, 2])[:, None, None]


def residuals_and_jacobians(model: PerspectiveModel, tracks: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Give the residuals (F, 2, P) and the model's derivative (F, 2, P, 6 + M) by left turn, shift and weights."""
    residual, by_point = seen_from(model, tracks, seen)
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
    """Give what distances lack (F, E) and their derivative (F, E, M) by the weights."""
    length, direction = lengths_of(model.shapes, model.pairs)
    apart = model.modes[:, :, model.pairs[:, 0]] - model.modes[:, :, model.pairs[:, 1]]
    by_weight = np.matmul(direction.transpose(2, 0, 1), apart.transpose(2, 1, 0)).transpose(1, 0, 2)
    return model.distance - length, by_weight


def improbability(model: PerspectiveModel, tracks: Floats, seen: Floats) -> float:
    """Give minus the logarithm of the probability, up to a constant, of this very answer."""
    if float(model.points[:, 2].min()) <= 0:
        return np.inf
    residual = seen_from(model, tracks, seen)[0]
    lacking = model.distance - lengths_of(model.shapes, model.pairs)[0]
    frames = len(tracks)
    turns, jerks = accelerations(model.rotation), np.diff(model.shift, 2, axis=0)
    total = float((residual**2).sum()) / model.variance + 2 * float(seen.sum()) * np.log(model.variance)
    total += model.share * float((lacking**2 / model.stretch).sum() + frames * np.log(model.stretch).sum())
    for values, variance in zip((turns, jerks), model.unsteadiness, strict=True):
        total += float((values**2).sum()) / variance + values.size * np.log(variance)
    return 0.5 * total + model.processes.cost(model.weights)


def frame_equations(model: PerspectiveModel, tracks: Floats, seen: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Write the normal equations of all frames, given the shapes, as `solve_banded` takes them."""
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    frames, unknowns = len(tracks), jacobian.shape[-1]
    flat = jacobian.reshape(frames, -1, unknowns)
    diagonal = np.swapaxes(flat, 1, 2) @ flat / model.variance
    right = (np.swapaxes(flat, 1, 2) @ residual.reshape(frames, -1, 1))[..., 0] / model.variance
    lacking, by_weight = distance_jacobians(model)
    weighed = by_weight * (model.share / model.stretch)[:, None]
    diagonal[:, MOTION:, MOTION:] += np.swapaxes(weighed, 1, 2) @ by_weight
    right[:, MOTION:] += (np.swapaxes(weighed, 1, 2) @ lacking[..., None])[..., 0]
    diagonal[:, range(MOTION), range(MOTION)] += 1e-8
    first, second = np.zeros_like(diagonal), np.zeros_like(diagonal)
    add_steadiness(diagonal, first, second, right, model.rotation, 1 / model.unsteadiness[0])
    _add_smooth_shift(diagonal, first, second, right, model)
    model.processes.add(diagonal, first, second, right, model.weights, MOTION)
    return diagonal, first, second, right


def solve_frames(model: PerspectiveModel, tracks: Floats, seen: Floats) -> None:
    """Do one Gauss-Newton step of all frames together, shortened until it helps; sets covariance and cost."""
    step, *covariance, determinant = solve_banded(*frame_equations(model, tracks, seen))
    model.covariance = (covariance[0], covariance[1], covariance[2])
    before = improbability(model, tracks, seen)
    model.cost = before + 0.5 * determinant
    start = model.rotation, model.shift, model.weights
    share = min(1.0, LONGEST_TURN / max(float(np.abs(step[:, :3]).max()), 1e-300))
    for _ in range(HALVINGS):
        model.rotation = rotations.exp(share * step[:, :3]) @ start[0]
        model.shift = start[1] + share * step[:, 3:MOTION]
        model.weights = start[2] + share * step[:, MOTION:]
        if improbability(model, tracks, seen) <= before:
            return
        share /= 2
    model.rotation, model.shift, model.weights = start


def _add_smooth_shift(diagonal: Floats, first: Floats, second: Floats, right: Floats, model: PerspectiveModel) -> None:
    """Add the shift's squared second differences over their variance."""
    jerks, precision, own = np.diff(model.shift, 2, axis=0), 1 / model.unsteadiness[1], np.arange(3, MOTION)
    by = (1.0, -2.0, 1.0)
    for k in range(3):
        span = slice(k, len(model.shift) - 2 + k)
        diagonal[span, own, own] += precision * by[k] ** 2
        right[span, 3:MOTION] -= precision * by[k] * jerks
    first[:-2, own, own] += precision * by[0] * by[1]
    first[1:-1, own, own] += precision * by[1] * by[2]
    second[:-2, own, own] += precision * by[0] * by[2]


def equations_of_shapes(
    model: PerspectiveModel, tracks: Floats, seen: Floats, *, certain: bool = False
) -> ShapeEquations:
    """Write the equations of the mean shape and the modes; `certain` takes the frames for known."""
    residual, by_point = seen_from(model, tracks, seen)
    by_shape = np.einsum("fkip,fij->fkjp", by_point, model.rotation)
    shapes = model.shapes
    wanted = residual + np.einsum("fkjp,fjp->fkp", by_shape, shapes)
    row = model.row
    square, moved = row[:, :, None] * row[:, None], _moved(model)
    if certain:
        moved = np.zeros_like(moved)
    else:
        square[:, 1:, 1:] += model.covariance[0][:, MOTION:, MOTION:]
    direction = lengths_of(shapes, model.pairs)[1]
    sharp, tight = 1 / np.sqrt(model.variance), np.sqrt(model.share / model.stretch)
    return shape_equations(
        row, square, by_shape * sharp, wanted * sharp, moved, model.pairs, direction * tight, model.distance * tight
    )


def solve_shapes(model: PerspectiveModel, tracks: Floats, seen: Floats) -> None:
    """Solve for the mean shape and the modes, given what is known of the frames, and set the gauge anew."""
    basis = np.concatenate([model.mean[None], model.modes])
    basis = solve_shape_equations(equations_of_shapes(model, tracks, seen), basis)
    # What is not known of the weights counts here and not in `improbability`, which therefore may rise a little.
    enough, start = improbability(model, tracks, seen) + float(seen.sum()), (model.mean, model.modes)
    for halving in range(HALVINGS):
        share = 0.5**halving
        model.mean = (1 - share) * start[0] + share * basis[0]
        model.modes = (1 - share) * start[1] + share * basis[1:]
        if improbability(model, tracks, seen) <= enough:
            break
    else:
        model.mean, model.modes = start
    give_up_modes(model)
    set_gauge(model)


def give_up_modes(model: PerspectiveModel) -> None:
    """Leave out modes that do next to nothing: nothing holds their weights, which would grow without limit."""
    own = np.einsum("fmm->m", model.covariance[0][:, MOTION:, MOTION:]) / len(model.weights)
    moved = ((model.weights**2).mean(0) + own) * (model.modes**2).mean((1, 2))
    kept = np.flatnonzero(moved > SLIGHTEST**2)
    unknowns = np.concatenate([np.arange(MOTION), MOTION + kept])
    model.modes, model.weights = model.modes[kept], model.weights[:, kept]
    model.processes = model.processes.among(kept)
    here, near, far = (part[:, unknowns][:, :, unknowns] for part in model.covariance)
    model.covariance = (here, near, far)


def _moved(model: PerspectiveModel) -> Floats:
    """Give the expected product (F, 1 + M, 3, P) of what is not known of the weights and of the motion of the points.

    A size that swells while the object moves away is hardly known, neither as weight nor as distance, but both
    together explain the tracks: without this product such modes would shrink, as if each were wrong alone.
    """
    together = np.pad(model.covariance[0][:, MOTION:, :MOTION], ((0, 0), (1, 0), (0, 0)))
    carried = (model.rotation @ model.shapes)[:, None]
    moved = np.cross(together[..., :3, None], carried, axis=2) + together[..., 3:, None]
    return np.asarray(np.swapaxes(model.rotation, 1, 2)[:, None] @ moved)


def set_gauge(model: PerspectiveModel) -> None:
    """Put the origin at the centre, the size to 1, and the mean's motions, to first order, from modes to poses."""
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
    model.distance, model.stretch = model.distance / size, model.stretch / size**2


def solve_variances(model: PerspectiveModel, tracks: Floats, seen: Floats, least_noise: float) -> None:
    """Estimate noise, distances and their spread, the weights' processes and the unsteadiness anew."""
    residual, jacobian = residuals_and_jacobians(model, tracks, seen)
    frames = len(tracks)
    flat = jacobian.reshape(frames, -1, jacobian.shape[-1])
    doubt = float(np.einsum("fde,fde->", np.swapaxes(flat, 1, 2) @ flat, model.covariance[0]))
    model.variance = max((float((residual**2).sum()) + doubt) / (2 * float(seen.sum())), least_noise**2)
    of_weights = tuple(part[:, MOTION:, MOTION:] for part in model.covariance)
    lacking, by_weight = distance_jacobians(model)
    model.distance = model.distance - lacking.mean(0)
    squares = (lacking - lacking.mean(0)) ** 2 + np.einsum("fem,fem->fe", by_weight @ of_weights[0], by_weight)
    common = float(np.median(squares.mean(0) / model.distance**2)) if squares.size else 0.0
    own = STRETCH_FREEDOM * common * model.distance**2 + squares.sum(0)
    model.stretch = own / (STRETCH_FREEDOM + frames) + (LEAST_STRETCH * model.distance) ** 2
    model.processes.learn(model.weights, (of_weights[0], of_weights[1], of_weights[2]))
    turns, jerks = accelerations(model.rotation), np.diff(model.shift, 2, axis=0)
    model.unsteadiness = (
        max(float((turns**2).mean()), STEADIEST**2),
        max(float((jerks**2).mean()), STEADIEST**2),
    )


def improve(model: PerspectiveModel, tracks: Floats, seen: Floats, rounds: int, least_noise: float) -> None:
    """Do rounds of all three steps, and once more the first, so that covariance and cost are those of the end."""
    for _ in range(rounds):
        solve_frames(model, tracks, seen)
        solve_shapes(model, tracks, seen)
        solve_variances(model, tracks, seen, least_noise)
    solve_frames(model, tracks, seen)
