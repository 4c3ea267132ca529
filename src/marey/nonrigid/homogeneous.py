"""Shape and motion of a deforming set of points in space: the homogeneous factorisation, solved by least squares.

The points of frame t are T_t (S_1 + c_t2 S_2 + ... + c_tK S_K) ([Alexander2003] eq. (15)-(18)), T_t a rigid motion.
Unlike the paper, which takes T and the weights from singular vectors and mends them with one corrective matrix,
everything is solved for together: poses by Gauss-Newton on the manifold of rigid motions, basis shapes point by
point, missing points left out, the weights held by their own spread. Homogeneous coordinates (the fourth row of a
shape is 1) say that the weights of the mean shape are 1; S_2 ... S_K are displacements and their fourth row is 0.

The factorisation leaves a choice ("gauge"): a motion and a displacement that looks like it cannot be told apart. Here
displacements carry no motion of the mean shape: neither a translation nor, to first order, a rotation. So T_t is the
motion from which the points depart least, and no more than that is known about the bone beneath. (Left free, the
motions of real skin wander by tens of degrees for a hundredth of the residual.)
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, frozen
from marey.errors import MareyError
from marey.geometry import rotations
from marey.nonrigid.alignment import mean_shape

ROUNDS = 100
STILL = 1e-6
"""The change of the fit's root mean square, as a share of it, at which the rounds end."""
LEAST_SPREAD = 1e-12
"""Least variance, as a share of the mean shape's, of a weight and of the noise; keeps exact data solvable."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HomogeneousShapes:
    """The shapes and rigid motions of P points over F frames; NaN where there is no answer.

    The object's frame lies at the centre of the mean shape; its axes are those of the laboratory in frame `reference`.
    """

    shape: Floats
    """(F, 3, P) in the object's frame, in the unit of the points; also of points that were missing (`predicted`)."""
    shape_sd: Floats
    """(F, 3, P) standard deviation of the shape, from the noise about the model."""
    rotation: Floats
    """(F, 3, 3) laboratory from object."""
    translation: Floats
    """(F, 3) the object's origin in the laboratory."""
    covariance: Floats
    """(F, 6, 6) of the turn about the object's axes, exp(turn) to the right of the rotation [rad], and of the
    translation; from the noise about the model alone, not from what all points do together and the bone does not."""
    basis: Floats
    """(K, 3, P) the mean shape, and displacements of root mean square 1 a point, uncorrelated, the largest first."""
    coefficients: Floats
    """(F, K) the weights; the first is 1, the others are in the unit of the points."""
    noise_sd: float
    """Standard deviation of a coordinate about the model."""
    residuals: Floats
    """(F, P) distance of each measured point from the model; NaN where missing."""
    predicted: Mask
    """(F, P) true where the shape of a missing point is given."""
    reference: int
    """The frame in which the object's axes are those of the laboratory."""

    def __post_init__(self) -> None:
        for name in (
            "shape",
            "shape_sd",
            "rotation",
            "translation",
            "covariance",
            "basis",
            "coefficients",
            "residuals",
        ):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        object.__setattr__(self, "predicted", frozen(self.predicted, bool))

    @property
    def rank(self) -> int:
        """K, the number of basis shapes with the mean."""
        return len(self.basis)

    @property
    def homogeneous_basis(self) -> Floats:
        """(K, 4, P) the basis shapes with their fourth row ([Alexander2003] eq. (15)): 1 in the mean, else 0."""
        fourth = np.zeros((self.rank, 1, self.basis.shape[2]))
        fourth[0] = 1
        return np.concatenate([self.basis, fourth], 1)

    @property
    def points(self) -> Floats:
        """(F, P, 3) the model's points in the laboratory."""
        return np.asarray(np.einsum("fij,fjp->fpi", self.rotation, self.shape) + self.translation[:, None])

    @property
    def point_rms(self) -> Floats:
        """(P,) root mean square distance of each point from the model; NaN for one never measured."""
        seen = np.isfinite(self.residuals)
        total = np.where(seen, self.residuals, 0) ** 2
        return np.asarray(np.where(seen.any(0), np.sqrt(total.sum(0) / np.maximum(seen.sum(0), 1)), np.nan))


@dataclass
class _State:
    """What the rounds improve; frames without a pose and points without a place are left out beforehand."""

    rotation: Floats
    translation: Floats
    mean: Floats
    """(P, 3)."""
    modes: Floats
    """(M, P, 3) displacements, M = K - 1."""
    weights: Floats
    """(F, M)."""
    spread: Floats
    """(M,) variance of the weights."""
    weight_covariance: Floats
    """(F, M, M)."""
    variance: float
    """Of a coordinate about the model."""
    pose_covariance: Floats
    """(F, 6, 6) of turn and of the shift in the object's frame."""


def factorise_points(points: Floats, rank: int, *, reference: int | None = None) -> HomogeneousShapes:
    """Find basis shapes, weights and rigid motions of points in space ([Alexander2003] eq. (15)-(21)).

    Args:
        points: (F, P, 3) in any unit; NaN where a point is missing.
        rank: K, the number of basis shapes with the mean; 1 is the rigid fit to the mean shape.
        reference: the frame in which the object's axes are those of the laboratory; by default the first with a pose.

    Returns:
        The shapes; NaN in frames with fewer than three points, and for points never measured together with the rest.

    Raises:
        MareyError: The rank does not suit the numbers of frames and points, too little is measured, or the
            reference has no pose.
    """
    points = np.asarray(points, float)
    _check(points, rank)
    present: Mask = np.asarray(np.isfinite(points).all(-1))
    mean, rotation, translation = mean_shape(points, present)
    frames, kept = np.isfinite(rotation[:, 0, 0]), np.isfinite(mean[:, 0])
    _check_enough(frames, kept, rank)
    first = int(frames.argmax()) if reference is None else reference
    if not 0 <= first < len(points) or not frames[first]:
        raise MareyError(f"Frame {first} has fewer than three points off one line; another should be the reference.")
    inner, weight = points[np.ix_(frames, kept)], present[np.ix_(frames, kept)].astype(float)
    state = _begin(inner, weight, mean[kept], rotation[frames], translation[frames], rank - 1)
    _improve(state, np.nan_to_num(inner), weight)
    return _tell(state, points, frames, kept, first)


def _check(points: Floats, rank: int) -> None:
    if points.ndim != 3 or points.shape[2] != 3:
        raise MareyError(f"Points have the shape {points.shape} and should have (frames, points, 3).")
    if rank < 1:
        raise MareyError(f"The number of basis shapes is {rank} and should be at least 1.")


def _check_enough(frames: Mask, kept: Mask, rank: int) -> None:
    if frames.sum() < 2 or kept.sum() < 3:
        raise MareyError("Fewer than two frames have three points in common that do not lie on one line.")
    most = 1 + min(int(frames.sum()) - 1, 3 * int(kept.sum()) - 6)
    if rank > most:
        raise MareyError(
            f"{rank} basis shapes are too many for {kept.sum()} points over {frames.sum()} frames: "
            f"at most {most} can be told."
        )


def _begin(points: Floats, weight: Floats, mean: Floats, rotation: Floats, translation: Floats, modes: int) -> _State:
    """Begin with the singular vectors of what the rigid fit leaves; a missing point departs by nothing."""
    carried = np.einsum("fji,fpj->fpi", rotation, points - translation[:, None])
    left = np.where(weight[..., None] > 0, carried - mean, 0).reshape(len(points), -1)
    u, d, vt = np.linalg.svd(left, full_matrices=False)
    weights = u[:, :modes] * d[:modes]
    size = float((mean**2).mean())
    return _State(
        rotation=rotation, translation=translation, mean=mean, modes=vt[:modes].reshape(modes, *mean.shape),
        weights=weights, spread=(weights**2).mean(0) + LEAST_SPREAD * size,
        weight_covariance=np.zeros((len(points), modes, modes)), pose_covariance=np.zeros((len(points), 6, 6)),
        variance=float((left**2).sum() / (3 * weight.sum())) + LEAST_SPREAD * size,
    )  # fmt: skip


def _improve(state: _State, points: Floats, weight: Floats) -> None:
    before = np.inf
    for _ in range(ROUNDS):
        _solve_frames(state, points, weight)
        _solve_basis(state, points, weight)
        _fix_gauge(state)
        rms = _solve_frames(state, points, weight)
        if abs(before - rms) <= STILL * rms:
            break
        before = rms


def _carried(state: _State, points: Floats) -> Floats:
    """Give the points (F, P, 3) in the object's frame."""
    return np.asarray(np.einsum("fji,fpj->fpi", state.rotation, points - state.translation[:, None]))


def _departures(state: _State) -> Floats:
    return np.asarray(state.mean + np.einsum("fm,mpi->fpi", state.weights, state.modes))


def _solve_frames(state: _State, points: Floats, weight: Floats) -> float:
    """Do one Gauss-Newton step of every frame's pose and weights; give the root mean square of the residuals before it.

    In the object's frame the residual is e = y - S with y = R'(x - t); for R exp(w), t + R v and weights c + d it is
    e - v - w x y - d B to first order.
    """
    carried = _carried(state, points)
    residual = (carried - _departures(state)) * weight[..., None]
    modes = len(state.modes)
    jacobian = np.zeros((*carried.shape, 6 + modes))
    jacobian[..., :3] = rotations.hat(carried)
    jacobian[..., 3:6] = -np.eye(3)
    jacobian[..., 6:] = -np.moveaxis(state.modes, 0, -1)
    jacobian *= weight[..., None, None]
    flat = jacobian.reshape(len(points), -1, 6 + modes)
    normal = np.einsum("fnd,fne->fde", flat, flat, optimize=True) / state.variance
    right = -np.einsum("fnd,fn->fd", flat, residual.reshape(len(points), -1)) / state.variance
    normal[:, range(6, 6 + modes), range(6, 6 + modes)] += 1 / state.spread
    right[:, 6:] -= state.weights / state.spread
    step = np.linalg.solve(normal, right[..., None])[..., 0]
    covariance = np.linalg.inv(normal)
    state.pose_covariance, state.weight_covariance = covariance[:, :6, :6], covariance[:, 6:, 6:]
    state.translation = state.translation + np.einsum("fij,fj->fi", state.rotation, step[:, 3:6])
    state.rotation = state.rotation @ rotations.exp(step[:, :3])
    state.weights = state.weights + step[:, 6:]
    return float(np.sqrt((residual**2).sum() / (3 * weight.sum())))


def _solve_basis(state: _State, points: Floats, weight: Floats) -> None:
    """Solve every point's rows of the basis, given the frames; then the noise and the spread of the weights."""
    frames, modes = len(points), len(state.modes)
    carried = _carried(state, points)
    row = np.concatenate([np.ones((frames, 1)), state.weights], 1)
    square = row[:, :, None] * row[:, None]
    square[:, 1:, 1:] += state.weight_covariance
    normal = np.einsum("fp,fkl->pkl", weight, square, optimize=True)
    right = np.einsum("fp,fk,fpi->pki", weight, row, carried, optimize=True)
    ridge = LEAST_SPREAD * normal[:, 0, 0].max() * (1 + np.einsum("kk->k", square.mean(0)))
    normal[:, range(modes + 1), range(modes + 1)] += ridge
    solved = np.linalg.solve(normal, right)
    state.mean, state.modes = solved[:, 0], np.moveaxis(solved[:, 1:], 1, 0)
    residual = ((carried - _departures(state)) ** 2).sum(-1) * weight
    size = LEAST_SPREAD * float((state.mean**2).mean())
    free = 3 * weight.sum() - 6 * frames - frames * modes - 3 * len(state.mean) * (1 + modes) + modes * (modes + 6)
    state.variance = float(residual.sum() / max(free, 0.1 * 3 * weight.sum())) + size
    state.spread = (state.weights**2).mean(0) + np.einsum("fmm->m", state.weight_covariance) / frames + size


def _fix_gauge(state: _State) -> None:
    """Take the motion out of the displacements, make them uncorrelated, and the weights of mean zero."""
    state.mean = state.mean + np.einsum("m,mpi->pi", state.weights.mean(0), state.modes)
    state.weights = state.weights - state.weights.mean(0)
    shift = state.mean.mean(0)
    state.mean = state.mean - shift
    state.translation = state.translation + state.rotation @ shift
    if not len(state.modes):
        return
    middle = state.modes.mean(1)
    modes = state.modes - middle[:, None]
    inertia = np.eye(3) * (state.mean**2).sum() - state.mean.T @ state.mean
    turn = np.cross(state.mean[None], modes).sum(1) @ np.linalg.pinv(inertia)
    modes = modes - np.cross(turn[:, None], state.mean[None])
    state.translation = state.translation + np.einsum("fij,fm,mj->fi", state.rotation, state.weights, middle)
    state.rotation = state.rotation @ rotations.exp(state.weights @ turn)
    _uncorrelate(state, modes)


def _uncorrelate(state: _State, modes: Floats) -> None:
    """Turn displacements and weights so that both are orthogonal, the displacements of root mean square 1 a point."""
    count, points = modes.shape[:2]
    q, r = np.linalg.qr(modes.reshape(count, -1).T)
    u, d, vt = np.linalg.svd(state.weights @ r.T, full_matrices=False)
    turned = vt @ q.T
    largest = np.abs(turned).argmax(1)
    sign = np.where(turned[range(count), largest] < 0, -1.0, 1.0) * np.sqrt(points)
    state.modes = (turned * sign[:, None]).reshape(count, points, 3)
    state.weights = u * d / sign
    new_from_old = (vt @ r) / sign[:, None]
    state.weight_covariance = new_from_old @ state.weight_covariance @ new_from_old.T
    state.spread = (state.weights**2).mean(0) + np.einsum("fmm->m", state.weight_covariance) / len(u)
    state.spread = state.spread + LEAST_SPREAD * float((state.mean**2).mean())


def _tell(state: _State, points: Floats, frames: Mask, kept: Mask, reference: int) -> HomogeneousShapes:
    """Spread the answer over all frames and points, in the axes of the reference."""
    total, count, modes = len(points), points.shape[1], len(state.modes)
    # object of the answer from object of the state: the laboratory's axes in the reference frame
    turn = state.rotation[frames[:reference].sum()]
    basis = np.full((modes + 1, 3, count), np.nan)
    basis[:, :, kept] = np.einsum("ij,kpj->kip", turn, np.concatenate([state.mean[None], state.modes]))
    both = np.zeros((6, 6))
    both[:3, :3] = turn
    rotation, translation = np.full((total, 3, 3), np.nan), np.full((total, 3), np.nan)
    covariance, coefficients = np.full((total, 6, 6), np.nan), np.full((total, modes + 1), np.nan)
    rotation[frames], translation[frames] = state.rotation @ turn.T, state.translation
    to_laboratory = np.broadcast_to(both, (int(frames.sum()), 6, 6)).copy()
    to_laboratory[:, 3:, 3:] = state.rotation
    covariance[frames] = to_laboratory @ state.pose_covariance @ np.moveaxis(to_laboratory, 1, 2)
    coefficients[frames] = np.concatenate([np.ones((len(state.weights), 1)), state.weights], 1)
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    shape_sd = np.full(shape.shape, np.nan)
    variance = np.einsum("kip,fkl,lip->fip", basis[1:], state.weight_covariance, basis[1:], optimize=True)
    shape_sd[frames] = np.sqrt(variance + _basis_variance(state, points, frames, kept)[:, None])
    model = np.einsum("fij,fjp->fpi", rotation, shape) + translation[:, None]
    return HomogeneousShapes(
        shape=shape, shape_sd=shape_sd, rotation=rotation, translation=translation, covariance=covariance, basis=basis,
        coefficients=coefficients, noise_sd=float(np.sqrt(state.variance)),
        residuals=np.linalg.norm(points - model, axis=-1),
        predicted=np.isfinite(shape[:, 0]) & ~np.isfinite(points).all(-1), reference=reference,
    )  # fmt: skip


def _basis_variance(state: _State, points: Floats, frames: Mask, kept: Mask) -> Floats:
    """Give the variance (frames kept, P) that a coordinate of the shape has from the basis."""
    weight = np.isfinite(points[np.ix_(frames, kept)]).all(-1).astype(float)
    row = np.concatenate([np.ones((len(weight), 1)), state.weights], 1)
    normal = np.einsum("fp,fk,fl->pkl", weight, row, row, optimize=True)
    out = np.full((len(weight), len(kept)), np.nan)
    inverse = np.linalg.pinv(normal, hermitian=True) * state.variance
    out[:, kept] = np.einsum("fk,pkl,fl->fp", row, inverse, row, optimize=True)
    return out
