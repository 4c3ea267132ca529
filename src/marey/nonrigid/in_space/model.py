"""Least squares of the homogeneous factorisation: poses and weights, basis shapes, and noise, in turn."""

from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.geometry.vectors import products
from marey.nonrigid.in_space.measured_places import MeasuredPlaces, departures


@dataclass(frozen=True, kw_only=True)
class HomogeneousModelSettings:
    """Settings of the least squares; chosen by hand, results were not measured against other values."""

    rounds: int = 100
    """Largest number of rounds; a limit on time."""
    tolerance: float = 1e-3
    """Rounds end when the model's points move by less than this fraction of their noise, root mean square."""
    least_variance: float = 1e-12
    """Least variance of a weight and of the noise, as a fraction of the mean shape's; keeps exact data solvable."""
    mode_information: float = 3.0
    """Prior information of a coordinate of a mode; modes have root mean square 1 per point, over three coordinates."""
    pose_regularisation: float = 1e-9
    """Fraction of the largest information about a frame's pose that is added to its diagonal; keeps frames without
    information solvable."""
    least_free_share: float = 0.1
    """Least fraction of the measured coordinates that counts as degrees of freedom of the noise."""


@dataclass
class HomogeneousModel:
    """P points over F frames, R (S_1 + sum of c_k S_k) + t, where each frame has a pose and each point a position."""

    rotation: Floats
    """(F, 3, 3) laboratory from object."""
    translation: Floats
    """(F, 3) object's origin in the laboratory."""
    mean: Floats
    """(P, 3) mean shape."""
    modes: Floats
    """(M, P, 3) deformation modes, M = K - 1."""
    weights: Floats
    """(F, M)."""
    weight_variance: Floats
    """(M,) variance of the weights over the frames."""
    weight_covariance: Floats
    """(F, M, M) covariance of the weights' estimates."""
    variance: float
    """Variance of a point's coordinate about the model."""
    pose_covariance: Floats
    """(F, 6, 6) covariance of the rotation about the object's axes and of the shift in the object's frame."""
    settings: HomogeneousModelSettings = field(default_factory=HomogeneousModelSettings)
    """Tuned constants of the least squares."""

    @property
    def shapes(self) -> Floats:
        """(F, P, 3) points in the object's frame."""
        flat = self.weights @ self.modes.reshape(len(self.modes), self.mean.size)
        return np.asarray(self.mean + flat.reshape(-1, *self.mean.shape))

    @property
    def places(self) -> Floats:
        """(F, P, 3) points in the laboratory."""
        return np.asarray(self.shapes @ np.swapaxes(self.rotation, 1, 2) + self.translation[:, None])

    @property
    def row(self) -> Floats:
        """(F, K) weights of the basis shapes, including the mean's."""
        return np.concatenate([np.ones((len(self.weights), 1)), self.weights], 1)

    @property
    def floor(self) -> float:
        """Least variance of weights and noise."""
        return self.settings.least_variance * float((self.mean**2).mean())


def rigid_model(
    mean: Floats,
    rotation: Floats,
    translation: Floats,
    places: MeasuredPlaces,
    settings: HomogeneousModelSettings = HomogeneousModelSettings(),
) -> HomogeneousModel:
    """Create a model from one shape (P, 3) and its motion (F, 3, 3), (F, 3)."""
    frames = len(rotation)
    model = HomogeneousModel(
        rotation=rotation, translation=translation, mean=mean, modes=np.zeros((0, *mean.shape)),
        weights=np.zeros((frames, 0)), weight_variance=np.zeros(0), weight_covariance=np.zeros((frames, 0, 0)),
        variance=float((mean**2).mean()), pose_covariance=np.zeros((frames, 6, 6)),
        settings=settings,
    )  # fmt: skip
    away, unsure = departures(places, model.places, model.variance)
    model.variance = float(((away**2).sum(-1) + unsure).sum() / (3 * places.seen.sum())) + model.floor
    return model


def with_more_modes(model: HomogeneousModel, places: MeasuredPlaces, count: int) -> HomogeneousModel:
    """Add modes: the leading singular vectors of the residuals, with zero for missing points."""
    away, _ = departures(places, model.places, model.variance)
    left = (away @ model.rotation).reshape(len(away), -1)
    u, d, vt = np.linalg.svd(left, full_matrices=False)
    frames, before = model.weights.shape
    weights = u[:, :count] * d[:count]
    covariance = np.zeros((frames, before + count, before + count))
    covariance[:, :before, :before] = model.weight_covariance
    # the noise after the new modes: with the previous one, the prior of the modes would have too much weight
    share = float((d[count:] ** 2).sum() / max((d**2).sum(), 1e-300))
    modes = vt[:count].reshape(count, *model.mean.shape)
    return replace(
        model, variance=model.variance * share + model.floor, modes=np.concatenate([model.modes, modes]),
        weights=np.concatenate([model.weights, weights], 1), weight_covariance=covariance,
        weight_variance=np.concatenate([model.weight_variance, (weights**2).mean(0) + model.floor]),
    )  # fmt: skip


def refine(
    model: HomogeneousModel, places: MeasuredPlaces, *, rounds: int | None = None, tolerance: float | None = None
) -> None:
    """Solve for poses, weights, basis and noise in turn until the points converge.

    Args:
        model: Changed in place.
        places: Measured points.
        rounds: Largest number of rounds; from the model's settings if None.
        tolerance: See `HomogeneousModelSettings.tolerance`; from the model's settings if None.
    """
    rounds = model.settings.rounds if rounds is None else rounds
    tolerance = model.settings.tolerance if tolerance is None else tolerance
    own = float(np.nanmedian(places.known_variance)) / 3
    solve_frames(model, places)
    before = model.places
    for _ in range(rounds):
        _solve_basis(model, places)
        _fix_gauge(model)
        solve_frames(model, places)
        _solve_variances(model, places)
        after = model.places
        if np.sqrt(np.mean((after - before) ** 2)) <= tolerance * np.sqrt(model.variance + own):
            break
        before = after
    solve_frames(model, places)


def turned(information: Floats, rotation: Floats) -> Floats:
    """Rotate information into the object's axes; isotropic information does not change."""
    if information.shape[-1] == 1:
        return information
    return np.asarray(np.swapaxes(rotation, 1, 2)[:, None] @ information @ rotation[:, None])


def _times(information: Floats, vectors: Floats) -> Floats:
    """Multiply information (..., 3, 3) or (..., 1, 1) with columns (..., 3, n)."""
    return information * vectors if information.shape[-1] == 1 else information @ vectors


def solve_frames(model: HomogeneousModel, places: MeasuredPlaces) -> None:
    """Do one Gauss-Newton step of the pose and the weights of each frame.

    For R exp(w), t + R v and weights c + d a shape S moves in the object's frame by w x S + v + d B to first order.
    """
    at, modes = model.places, len(model.modes)
    information, pull = places.equations(at, model.variance)
    jacobian = np.empty((*at.shape, 6 + modes))
    jacobian[..., :3] = -rotations.hat(model.shapes)
    jacobian[..., 3:6] = np.eye(3)
    jacobian[..., 6:] = np.moveaxis(model.modes, 0, -1)
    weighted = _times(turned(information, model.rotation), jacobian).reshape(len(at), -1, 6 + modes)
    flat = np.swapaxes(jacobian.reshape(len(at), -1, 6 + modes), 1, 2)
    normal = flat @ weighted
    right = (flat @ (pull @ model.rotation).reshape(len(at), -1, 1))[..., 0]
    normal[:, range(6, 6 + modes), range(6, 6 + modes)] += 1 / model.weight_variance
    right[:, 6:] -= model.weights / model.weight_variance
    normal[:, range(6), range(6)] += model.settings.pose_regularisation * np.einsum("fii->fi", normal[:, :6, :6]).max(
        1, keepdims=True
    )
    covariance = np.linalg.inv(normal)
    step = products(covariance, right)
    model.pose_covariance, model.weight_covariance = covariance[:, :6, :6], covariance[:, 6:, 6:]
    model.translation = model.translation + np.einsum("fij,fj->fi", model.rotation, step[:, 3:6])
    model.rotation = model.rotation @ rotations.exp(step[:, :3])
    model.weights = model.weights + step[:, 6:]


def basis_normal(model: HomogeneousModel, information: Floats, square: Floats) -> Floats:
    """Compute the information about each point's rows of the basis.

    Args:
        model: The model.
        information: (F, P, 3, 3) or (F, P, 1, 1) in the object's axes.
        square: (F, K, K) products of the weights.

    Returns:
        (P, K, K) where it is isotropic, else (P, 3 K, 3 K) with the axes varying fastest.
    """
    count, points = square.shape[1], information.shape[1]
    flat = square.reshape(len(square), -1).T @ information.reshape(len(square), -1)
    if information.shape[-1] == 1:
        return np.asarray(flat.T.reshape(points, count, count))
    blocks = flat.reshape(count, count, points, 3, 3).transpose(2, 0, 3, 1, 4)
    return np.asarray(blocks.reshape(points, 3 * count, 3 * count))


def add_prior(model: HomogeneousModel, normal: Floats, count: int) -> None:
    """Add the prior of the modes, which points seen in few frames need, and a negligible one of the mean.

    Args:
        model: Settings.
        normal: (P, K, K) or (P, 3 K, 3 K) as from `basis_normal`; changed in place.
        count: Number of basis shapes K.
    """
    each = normal.shape[1] // count
    held = np.full(normal.shape[1], model.settings.mode_information)
    held[:each] = model.settings.least_variance * normal[:, 0, 0].max()
    normal[:, range(len(held)), range(len(held))] += held


def _solve_basis(model: HomogeneousModel, places: MeasuredPlaces) -> None:
    """Solve for each point's rows of the basis, given the frames."""
    row, count = model.row, 1 + len(model.modes)
    information, pull = places.equations(model.places, model.variance)
    information = turned(information, model.rotation)
    square = row[:, :, None] * row[:, None]
    square[:, 1:, 1:] += model.weight_covariance
    normal = basis_normal(model, information, square)
    wanted = pull @ model.rotation + _times(information, model.shapes[..., None])[..., 0]
    right = (row.T @ wanted.reshape(len(row), -1)).reshape(count, -1, 3).swapaxes(0, 1)
    add_prior(model, normal, count)
    solved = np.linalg.solve(normal, right.reshape(len(right), normal.shape[1], -1)).reshape(right.shape)
    model.mean, model.modes = solved[:, 0], np.moveaxis(solved[:, 1:], 1, 0)


def _solve_variances(model: HomogeneousModel, places: MeasuredPlaces) -> None:
    """Estimate the noise about the model, and the variance of the weights.

    Squared residuals are divided by the number of coordinates that the measurements determine ([MacKay1992]).
    """
    information, pull = places.equations(model.places, model.variance)
    same = 3 if information.shape[-1] == 1 else 1
    determined = same * model.variance * float(np.trace(information, axis1=2, axis2=3).sum())
    total = float(((model.variance * pull) ** 2).sum())
    model.variance = total / (determined * free_share(model, places)) + model.floor
    among_frames = np.einsum("fmm->m", model.weight_covariance) / len(model.weights)
    model.weight_variance = (model.weights**2).mean(0) + among_frames + model.floor


def free_share(model: HomogeneousModel, places: MeasuredPlaces) -> float:
    """Compute the fraction of the measured coordinates that remains after the model's parameters."""
    (frames, modes), points = model.weights.shape, len(model.mean)
    taken = 6 * frames + frames * modes + 3 * points * (1 + modes) - modes * (modes + 6)
    return float(max(1 - taken / places.coordinates, model.settings.least_free_share))


def _fix_gauge(model: HomogeneousModel) -> None:
    """Remove motion from the modes, make them uncorrelated, and centre the weights."""
    model.mean = model.mean + np.einsum("m,mpi->pi", model.weights.mean(0), model.modes)
    model.weights = model.weights - model.weights.mean(0)
    shift = model.mean.mean(0)
    model.mean = model.mean - shift
    model.translation = model.translation + model.rotation @ shift
    if not len(model.modes):
        return
    middle = model.modes.mean(1)
    modes = model.modes - middle[:, None]
    inertia = np.eye(3) * (model.mean**2).sum() - model.mean.T @ model.mean
    turn = np.cross(model.mean[None], modes).sum(1) @ np.linalg.pinv(inertia)
    modes = modes - np.cross(turn[:, None], model.mean[None])
    model.translation = model.translation + np.einsum("fij,fm,mj->fi", model.rotation, model.weights, middle)
    model.rotation = model.rotation @ rotations.exp(model.weights @ turn)
    _uncorrelate(model, modes)


def _uncorrelate(model: HomogeneousModel, modes: Floats) -> None:
    """Rotate modes and weights so that both are orthogonal and the modes have root mean square 1 per point."""
    count, points = modes.shape[:2]
    q, r = np.linalg.qr(modes.reshape(count, -1).T)
    u, d, vt = np.linalg.svd(model.weights @ r.T, full_matrices=False)
    turned = vt @ q.T
    largest = np.abs(turned).argmax(1)
    sign = np.where(turned[range(count), largest] < 0, -1.0, 1.0) * np.sqrt(points)
    model.modes = (turned * sign[:, None]).reshape(count, points, 3)
    model.weights = u * d / sign
    new_from_old = (vt @ r) / sign[:, None]
    model.weight_covariance = new_from_old @ model.weight_covariance @ new_from_old.T
    of_estimates = np.einsum("fmm->m", model.weight_covariance) / len(u)
    model.weight_variance = (model.weights**2).mean(0) + of_estimates + model.floor
