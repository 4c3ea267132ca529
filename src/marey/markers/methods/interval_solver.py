"""Least squares for a bone's motion and its markers' paths on the bone, with the motion eliminated."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from marey.arrays import Floats, Integers, Mask
from marey.geometry import rotations
from marey.markers.data.cluster_data import ClusterData
from marey.markers.data.rigid_fit import fit_rigid

_MAXIMUM_ROUNDS = 30
"""Most Gauss-Newton steps. Chosen by hand."""
_ROUNDS_BEFORE_LEARNING = 2
"""Steps before the spread of the displacements and the residuals' variance are estimated. Chosen by hand."""
_CONVERGED_RATIO = 1e-2
"""The iteration ends when no coefficient changes by more than this ratio to the noise. Chosen by hand."""
_CHUNK = 4_000_000
"""Numbers held in memory at once in sums over the frames."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinProblem:
    """One cluster of M markers over F frames, whose paths on the bone are sums of Q functions of time."""

    data: ClusterData
    answered: Mask
    """(F,) True where a frame has enough markers."""
    functions: Floats
    """(F, 1 + Q) the constant 1, then the functions, which are 0 in the first known posture."""
    moving: Mask
    """(M, Q) True where a marker follows the function."""
    noise_m: float
    """Standard deviation of a measured coordinate [m]."""

    @property
    def weight(self) -> Floats:
        """(F, M) inverse variance of the noise [1/m2]; 0 for unused markers."""
        return np.asarray((self.data.present & self.answered[:, None]) / self.noise_m**2)


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinFit:
    """The markers' paths on the bone and the bone's motion; frames without an estimate hold an arbitrary pose."""

    coefficients: Floats
    """(M, 1 + Q, 3) each marker's constant position on the bone, then its displacement by each function [m]."""
    rotation: Floats
    """(F, 3, 3) laboratory from bone."""
    origin: Floats
    """(F, 3) the bone's origin in the laboratory [m]."""
    excess: float
    """Ratio of the residuals' variance to that of the noise, at least 1."""
    memory: float
    """Number of consecutive frames that carry the information of one, from the residuals' autocorrelation."""
    spread: Floats
    """(Q,) standard deviation of the displacements by each function, estimated from the data [m]."""
    covariance: Floats
    """(M (1 + Q) 3, ...) covariance of the coefficients [m2]."""
    squares: float
    """Sum of squared residuals divided by the variance of the noise, without the known postures."""
    free: float
    """Number of measured coordinates in that sum, minus six per frame."""
    known_squares: float
    """The same sum over the known postures."""
    last_change: float
    """Largest change of a coefficient in the last step [m]."""

    def places(self, functions: Floats) -> Floats:
        """Return the markers' positions (F, M, 3) on the bone [m]."""
        return np.asarray(np.einsum("fk,mki->fmi", functions, self.coefficients))


def solve(
    problem: SkinProblem, rotation: Floats, origin: Floats, spread_m: float, most_frames: int | None = None
) -> SkinFit:
    """Estimate coefficients and motion together ([Alexander2001], [Alexander2003] eq. (6)-(8)).

    Minimises the weighted sum of squared residuals. Each unknown pose is eliminated from its own frame, so that
    displacements that are nearly equivalent to a motion of the bone converge like all others. The poses in the known
    postures are fixed and resolve the remaining ambiguity. Unlike the paper, the displacements have a prior standard
    deviation estimated from the data, and frames with correlated residuals are down-weighted: real skin does not
    sensitivity any form exactly, and its misfit must not determine the displacements.

    Args:
        problem: The observations and the form.
        rotation: (F, 3, 3) initial rotations.
        origin: (F, 3) initial origins [m].
        spread_m: Initial standard deviation of the displacements [m].
        most_frames: In a longer trial, the coefficients are estimated from this number of evenly spaced frames; None
            for all frames.

    Returns:
        The coefficients and the motion in all frames.
    """
    chosen = _chosen(problem, most_frames)
    fit = _solve(_thinned(problem, chosen), rotation[chosen], origin[chosen], spread_m)
    if len(chosen) < len(rotation):
        rigid = fit_rigid(fit.places(problem.functions), problem.data.points, problem.noise_m)
        known = _with_known_poses(problem, rigid.rotation, rigid.translation)
        fit = replace(fit, rotation=known[0], origin=known[1])
    return fit


def _chosen(problem: SkinProblem, most_frames: int | None) -> Integers:
    """Choose the frames for the coefficients: evenly spaced, and the known postures."""
    answered = np.flatnonzero(problem.answered)
    if most_frames is None or len(answered) <= most_frames:
        return np.arange(len(problem.answered))
    even = answered[np.linspace(0, len(answered) - 1, most_frames).round().astype(int)]
    return np.union1d(even, problem.data.frames)


def _thinned(problem: SkinProblem, chosen: Integers) -> SkinProblem:
    frames = np.searchsorted(chosen, problem.data.frames)
    data = replace(problem.data, points=problem.data.points[chosen], frames=frames)
    return replace(problem, data=data, answered=problem.answered[chosen], functions=problem.functions[chosen])


def _solve(problem: SkinProblem, rotation: Floats, origin: Floats, spread_m: float) -> SkinFit:
    functions = problem.functions.shape[1]
    coefficients = np.zeros((len(problem.data.labels), functions, 3))
    coefficients[:, 0] = problem.data.reference
    known = _with_known_poses(problem, rotation, origin)
    fit = SkinFit(
        coefficients=coefficients, rotation=known[0], origin=known[1], excess=1.0, memory=1.0,
        spread=np.full(functions - 1, spread_m), covariance=np.zeros((0, 0)),
        squares=0.0, free=1.0, known_squares=0.0, last_change=np.inf,
    )  # fmt: skip
    for number in range(_MAXIMUM_ROUNDS):
        fit = _with_residual_statistics(problem, fit, learning=number >= _ROUNDS_BEFORE_LEARNING)
        normal, right, sensitivity = _normal_equations(problem, fit)[:3]
        factor = lapack.dpotrf(normal, lower=1)[0]
        step = lapack.dpotrs(factor, right, lower=1)[0]
        fit = replace(_after_step(problem, fit, step, sensitivity), last_change=float(np.abs(step).max()))
        if number >= _ROUNDS_BEFORE_LEARNING:
            fit = replace(fit, spread=_spread(problem, fit, np.diagonal(lapack.dpotri(factor, lower=1)[0])))
        if number > _ROUNDS_BEFORE_LEARNING and fit.last_change < _CONVERGED_RATIO * problem.noise_m:
            break
    fit = _with_residual_statistics(problem, fit, learning=True)
    active = _active(problem)
    whole = np.zeros((len(active), len(active)))
    whole[np.ix_(active, active)] = np.linalg.inv(_normal_equations(problem, fit)[0])
    return replace(fit, covariance=whole)


def _with_known_poses(problem: SkinProblem, rotation: Floats, origin: Floats) -> tuple[Floats, Floats]:
    rotation = np.where(problem.answered[:, None, None], rotation, np.eye(3))
    origin = np.where(problem.answered[:, None], origin, 0.0)
    rotation[problem.data.frames], origin[problem.data.frames] = problem.data.rotation, problem.data.origin
    return rotation, origin


def _unknown(problem: SkinProblem) -> Mask:
    unknown = np.asarray(problem.answered.copy())
    unknown[problem.data.frames] = False
    return unknown


def _on_bone(problem: SkinProblem, fit: SkinFit) -> Floats:
    """Return the measured markers in the bone's frame (F, M, 3) [m]; 0 for unused markers."""
    carried = np.einsum("fji,fmj->fmi", fit.rotation, problem.data.points - fit.origin[:, None])
    return np.where(problem.weight[..., None] > 0, carried, 0.0)


def _residuals(problem: SkinProblem, fit: SkinFit) -> Floats:
    left = _on_bone(problem, fit) - fit.places(problem.functions)
    return np.where(problem.weight[..., None] > 0, left, 0.0)


def _with_residual_statistics(problem: SkinProblem, fit: SkinFit, *, learning: bool) -> SkinFit:
    """Update the residuals' sums, and if `learning` their excess variance and correlation."""
    residual, unknown = _residuals(problem, fit), _unknown(problem)
    by_frame = (problem.weight[..., None] * residual**2).sum((1, 2))
    squares, in_known = float(by_frame[unknown].sum()), float(by_frame[~unknown].sum())
    count = 3.0 * float((problem.weight[unknown] > 0).sum()) - 6.0 * float(unknown.sum())
    parameters = 3.0 * float(problem.moving.sum())
    fit = replace(fit, squares=squares, free=max(count, 1.0), known_squares=in_known)
    if not learning:
        return fit
    excess = max(squares / max(count - parameters, 1.0), 1.0)
    return replace(fit, excess=excess, memory=_correlation_frames(residual, unknown))


def _spread(problem: SkinProblem, fit: SkinFit, variance: Floats) -> Floats:
    """Estimate the standard deviation (Q,) of the displacements by each function [m], including their uncertainty."""
    active = _active(problem)
    uncertain = np.zeros(len(active))
    uncertain[active] = variance
    squares = _flat(fit.coefficients) ** 2 + uncertain
    by_function = np.where(active, squares, 0.0).reshape(-1, fit.coefficients.shape[1]).sum(0)[1:]
    counts = np.maximum(3.0 * problem.moving.sum(0), 1.0)
    return np.asarray(np.maximum(np.sqrt(by_function / counts), problem.noise_m))


def _correlation_frames(residual: Floats, unknown: Mask) -> float:
    """Return the correlation length of residuals in frames: one plus twice the sum of their autocorrelation.

    The sum ends where the autocorrelation falls below that of independent numbers.
    """
    flat = np.where(unknown[:, None, None], residual, 0.0).reshape(len(residual), -1)
    spectrum = (np.abs(np.fft.rfft(flat, 2 * len(flat), axis=0)) ** 2).sum(1)
    products: Floats = np.asarray(np.fft.irfft(spectrum), float)[: len(flat)]
    if products[0] <= 0:
        return 1.0
    likeness: Floats = np.divide(products, products[0])
    by_chance = 2 / float(np.count_nonzero(flat) or 1) ** 0.5
    gone = np.flatnonzero(likeness < by_chance)
    last = int(gone[0]) if len(gone) else len(likeness)
    return float(1 + 2 * likeness[1:last].sum())


def _normal_equations(problem: SkinProblem, fit: SkinFit) -> tuple[Floats, Floats, Floats, Floats]:
    """Sum the normal equations of the coefficients over the frames, with the poses eliminated.

    In the bone's frame the residual is e = y - B c, and e + y^ w - v - B dc for R exp(w), t + R v and c + dc.

    Returns:
        The normal matrix and the right-hand side of the coefficients, the sensitivity (F, 6, 3M) of the poses to
        residuals, and the inverses (F, 6, 6) of the poses' own normal matrices.
    """
    residual = _residuals(problem, fit).reshape(len(fit.rotation), -1)
    weight, weighted, sensitivity, inverse = _pose_terms(problem, fit)
    frame_weight = np.where(_unknown(problem), 1 / (fit.excess * fit.memory), 1.0)
    left = weight * residual + np.einsum("fxa,fay,fy->fx", weighted, sensitivity, residual, optimize=True)
    right = np.einsum("f,fk,fx->xk", frame_weight, problem.functions, left, optimize=True)
    normal = _normal(problem.functions, frame_weight, weight, weighted, sensitivity)
    active, precision = _active(problem), _precision(problem, fit)
    right = (right.ravel() - precision * _flat(fit.coefficients))[active]
    normal = normal[np.ix_(active, active)] + np.diag(precision[active])
    return normal, right, sensitivity, inverse


def _pose_terms(problem: SkinProblem, fit: SkinFit) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the weights (F, 3M), W J (F, 3M, 6), the poses' sensitivity (F, 6, 3M), and (J'WJ)^-1 (F, 6, 6)."""
    on_bone = _on_bone(problem, fit)
    frames, markers = on_bone.shape[:2]
    weight = np.repeat(problem.weight, 3, axis=1)
    jacobian = np.concatenate([rotations.hat(on_bone), np.broadcast_to(-np.eye(3), (frames, markers, 3, 3))], -1)
    jacobian = jacobian.reshape(frames, 3 * markers, 6)
    weighted = jacobian * weight[..., None]
    unknown = _unknown(problem)
    inverse = np.zeros((frames, 6, 6))
    inverse[unknown] = np.linalg.inv(np.swapaxes(jacobian[unknown], 1, 2) @ weighted[unknown])
    return weight, weighted, -inverse @ np.swapaxes(weighted, 1, 2), inverse


def _normal(functions: Floats, frame_weight: Floats, weight: Floats, weighted: Floats, sensitivity: Floats) -> Floats:
    """Sum B' (W - W J (J'WJ)^-1 J'W) B over the frames in chunks: (3M (1 + Q), 3M (1 + Q))."""
    frames, size = weight.shape
    count = functions.shape[1]
    total = np.zeros((count * count, size * size))
    for first in range(0, frames, max(_CHUNK // size**2, 1)):
        part = slice(first, first + max(_CHUNK // size**2, 1))
        projected = weighted[part] @ sensitivity[part]
        projected[:, np.arange(size), np.arange(size)] += weight[part]
        products = functions[part, :, None] * functions[part, None, :] * frame_weight[part, None, None]
        total += products.reshape(len(projected), -1).T @ projected.reshape(len(projected), -1)
    blocks = total.reshape(count, count, size, size)
    return np.asarray(blocks.transpose(2, 0, 3, 1).reshape(size * count, size * count))


def _active(problem: SkinProblem) -> Mask:
    """Find the estimated coefficients, in the order marker, axis, function."""
    moving = np.concatenate([np.ones((len(problem.moving), 1), bool), problem.moving], 1)
    return np.asarray(np.repeat(moving[:, None], 3, axis=1).ravel())


def _precision(problem: SkinProblem, fit: SkinFit) -> Floats:
    own = np.concatenate([[0.0], 1 / fit.spread**2])
    return np.asarray(np.broadcast_to(own, (3 * len(problem.moving), len(own))).ravel())


def _flat(coefficients: Floats) -> Floats:
    return np.asarray(np.swapaxes(coefficients, 1, 2).ravel())


def _after_step(problem: SkinProblem, fit: SkinFit, step: Floats, sensitivity: Floats) -> SkinFit:
    """Take a step of the coefficients, and the resulting step of every unknown pose."""
    markers, count = fit.coefficients.shape[:2]
    whole = np.zeros(markers * count * 3)
    whole[_active(problem)] = step
    change = np.swapaxes(whole.reshape(markers, 3, count), 1, 2)
    left = _residuals(problem, fit) - np.where(
        problem.weight[..., None] > 0, np.einsum("fk,mki->fmi", problem.functions, change), 0.0
    )
    pose = np.einsum("fax,fx->fa", sensitivity, left.reshape(len(left), -1))
    return replace(
        fit, coefficients=fit.coefficients + change,
        rotation=fit.rotation @ rotations.exp(pose[:, :3]),
        origin=fit.origin + np.einsum("fij,fj->fi", fit.rotation, pose[:, 3:]),
    )  # fmt: skip


def pose_covariance(problem: SkinProblem, fit: SkinFit) -> Floats:
    """Compute the covariance (F, 6, 6) of the poses, as in `BoneMotion.covariance`.

    It contains the frame's own noise and the uncertainty of the markers' paths; unobserved motions keep their prior
    standard deviation.
    """
    _, _, sensitivity, inverse = _pose_terms(problem, fit)
    count, size = fit.coefficients.shape[1], sensitivity.shape[2]
    blocks = fit.covariance.reshape(size, count, size, count).transpose(1, 3, 0, 2).reshape(count**2, size**2)
    pose = inverse * fit.excess
    step = max(_CHUNK // size**2, 1)
    for first in range(0, len(pose), step):
        part = slice(first, first + step)
        products = (problem.functions[part, :, None] * problem.functions[part, None]).reshape(-1, count**2)
        of_places = (products @ blocks).reshape(-1, size, size)
        pose[part] += sensitivity[part] @ of_places @ np.swapaxes(sensitivity[part], 1, 2)
    to_laboratory = np.zeros_like(pose)
    to_laboratory[:, :3, :3], to_laboratory[:, 3:, 3:] = np.eye(3), fit.rotation
    return np.asarray(to_laboratory @ pose @ np.swapaxes(to_laboratory, 1, 2))
