"""Least squares over a chain of bones: one pose per bone and frame, and joint parameters shared by all frames."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations
from marey.geometry.vectors import products
from marey.markers.methods.chain import PARAMETERS, ChainJoint, JointPlace, joint_gap

_MINIMUM_INFORMATION = 1e-3
"""Information added to every coordinate [1/rad2 or 1/m2], which keeps unobserved coordinates in place; numerical."""


class MarkerObservations(NamedTuple):
    """One bone's markers: positions on the bone, measured positions, and standard deviations."""

    places: Floats
    """(F, M, 3) in the bone's frame [m]; 0 where unknown."""
    points: Floats
    """(F, M, 3) in the laboratory [m]; 0 where missing."""
    used: Mask
    """(F, M) True where a marker is used."""
    sd: Floats
    """(M,) standard deviation of a coordinate [m]."""


class ChainState(NamedTuple):
    """The unknowns: poses and joints."""

    rotation: Floats
    """(F, S, 3, 3) laboratory from bone."""
    origin: Floats
    """(F, S, 3) [m]."""
    joints: tuple[JointPlace, ...]

    def moved(self, step: Floats, shared: Floats) -> "ChainState":
        """Return the state after a step: (F, S, 6) rotations about the bones' own axes and origins, (J, 10) joints."""
        return ChainState(
            self.rotation @ rotations.exp(step[..., :3]), self.origin + step[..., 3:],
            tuple(place.moved(s) for place, s in zip(self.joints, shared, strict=True)),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """The observations, and the prior knowledge of the joints."""

    shapes: tuple[MarkerObservations, ...]
    """One per segment."""
    joints: tuple[ChainJoint, ...]
    ends: tuple[tuple[int, int], ...]
    """(parent, child) of each joint, as indices of segments."""
    known: tuple[Floats, Floats]
    """Rotation (K, S, 3, 3) and origin (K, S, 3) of the bones in the known postures."""
    estimated: Mask
    """(J, 10) True for the joints' parameters that are estimated."""
    start: tuple[JointPlace, ...]
    """Prior means of the joints."""
    prior_sd: Floats
    """(J, 10) standard deviation of the parameters about their prior means [m or rad]."""
    known_sd: float
    """Standard deviation of a rigid constraint's gap in a known posture [m]."""
    rigid_sd_m: float
    """The same over the trial [m]."""


class ChainNormalEquations(NamedTuple):
    """The normal equations: frames (F, n, n), frames by shared parameters (F, n, P), shared parameters (P, P)."""

    frames: Floats
    gradient: Floats
    mixed: Floats
    shared: Floats
    shared_gradient: Floats
    cost: float


def marker_residuals(shape: MarkerObservations, rotation: Floats, origin: Floats) -> Floats:
    """Return modelled minus measured positions (F, M, 3) [m]; 0 where a marker is not used."""
    model = np.einsum("fij,fmj->fmi", rotation, shape.places) + origin[:, None]
    return np.where(shape.used[..., None], model - shape.points, 0.0)


def marker_rows(shape: MarkerObservations, rotation: Floats) -> Floats:
    """Return the derivatives of the markers by the bone's rotation and origin: (F, M, 3, 6)."""
    turn = -rotation[:, None] @ rotations.hat(shape.places)
    rows = np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], -1)
    return np.where(shape.used[..., None, None], rows, 0.0)


def linearise(chain: Chain, state: ChainState) -> ChainNormalEquations:
    """Linearise all observations at a state."""
    count, segments = state.rotation.shape[:2]
    size, shared = 6 * segments, PARAMETERS * len(chain.joints)
    frames, gradient = np.zeros((count, size, size)), np.zeros((count, size))
    mixed = np.zeros((count, size, shared))
    own, own_gradient = np.zeros((shared, shared)), np.zeros(shared)
    cost = 0.0
    for s, shape in enumerate(chain.shapes):
        at = slice(6 * s, 6 * s + 6)
        rows = marker_rows(shape, state.rotation[:, s]) / shape.sd[:, None, None]
        residual = marker_residuals(shape, state.rotation[:, s], state.origin[:, s]) / shape.sd[:, None]
        flat = rows.reshape(count, -1, 6)
        frames[:, at, at] += np.swapaxes(flat, 1, 2) @ flat
        gradient[:, at] += (np.swapaxes(flat, 1, 2) @ residual.reshape(count, -1, 1))[..., 0]
        cost += float((residual**2).sum())
    for j, place in enumerate(state.joints):
        gaps, wrt_bones, by_joint = _gap_at(chain, j, state.rotation, state.origin, place, chain.rigid_sd_m)
        index = np.concatenate([6 * end + np.arange(6) for end in chain.ends[j]])
        at = slice(PARAMETERS * j, PARAMETERS * (j + 1))
        frames[:, index[:, None], index] += np.swapaxes(wrt_bones, 1, 2) @ wrt_bones
        gradient[:, index] += products(np.swapaxes(wrt_bones, 1, 2), gaps)
        mixed[:, index, at] += np.swapaxes(wrt_bones, 1, 2) @ by_joint
        known, _, by_known = _gap_at(chain, j, *chain.known, place, chain.known_sd)
        for value, wrt in ((gaps, by_joint), (known, by_known)):
            own[at, at] += np.einsum("fra,frb->ab", wrt, wrt)
            own_gradient[at] += np.einsum("fra,fr->a", wrt, value)
            cost += float((value**2).sum())
        off = np.concatenate([place.in_parent - chain.start[j].in_parent, place.in_child - chain.start[j].in_child])
        own[at, at] += np.diag(1 / chain.prior_sd[j] ** 2)
        own_gradient[at][:6] += off / chain.prior_sd[j, :6] ** 2
        cost += float(((off / chain.prior_sd[j, :6]) ** 2).sum())
    keep = chain.estimated.ravel()
    return ChainNormalEquations(frames, gradient, mixed[..., keep], own[np.ix_(keep, keep)], own_gradient[keep], cost)


def _gap_at(
    chain: Chain, j: int, rotation: Floats, origin: Floats, place: JointPlace, rigid_sd_m: float
) -> tuple[Floats, Floats, Floats]:
    """Return the residuals of one joint over frames or known postures; only estimated parameters have derivatives."""
    parent, child = chain.ends[j]
    residual, rows, shared = joint_gap(
        chain.joints[j],
        place,
        (rotation[:, parent], origin[:, parent]),
        (rotation[:, child], origin[:, child]),
        rigid_sd_m,
    )
    return residual, rows, shared * chain.estimated[j]


class ChainStep(NamedTuple):
    """A solved step."""

    frames: Floats
    """(F, S, 6) step of the poses [rad, m]."""
    shared: Floats
    """(J, 10) step of the joints' parameters."""
    covariance: Floats
    """(F, 6 S, 6 S) covariance of the poses, including the uncertainty of the shared parameters."""
    predicted: float
    """Decrease of the cost predicted by the linearisation."""


def descend(
    chain: Chain, state: ChainState, *, maximum_steps: int = 60, stop: float = 1e-7, cost_tolerance: float = 1e-7
) -> tuple[ChainState, ChainStep]:
    """Find the state of minimum cost by damped Gauss-Newton.

    Args:
        chain: The observations.
        state: Initial state.
        maximum_steps: Most steps.
        stop: A step shorter than this [rad, m] ends the iteration.
        cost_tolerance: A step that decreases the cost by less than this fraction ends the iteration.

    Returns:
        The state, and an undamped step at it, for its covariance.
    """
    damping = 1e-9
    system = linearise(chain, state)
    for _ in range(maximum_steps):
        step = solve(chain, system, damping)
        tried, there = _tried(chain, state, step, 1.0)
        if there.cost > system.cost - 0.5 * step.predicted:
            # The constraints are nonlinear in the rotations: the plain step is then about twice too long.
            half, there_half = _tried(chain, state, step, 0.5)
            if there_half.cost < there.cost:
                tried, there = half, there_half
        gained = system.cost - there.cost
        if gained >= 0:
            state, system, damping = tried, there, max(0.1 * damping, 1e-12)
        else:
            damping *= 10
        longest = max(np.abs(step.frames).max(), np.abs(step.shared).max(initial=0.0))
        if longest < stop or 0 <= gained < cost_tolerance * system.cost or damping > 1e6:
            break
    return state, solve(chain, system, 0.0)


def _tried(chain: Chain, state: ChainState, step: ChainStep, share: float) -> tuple[ChainState, ChainNormalEquations]:
    """Take a fraction of a step."""
    moved = state.moved(share * step.frames, share * step.shared)
    return moved, linearise(chain, moved)


def solve(chain: Chain, system: ChainNormalEquations, damping: float) -> ChainStep:
    """Solve for a damped step by elimination of the frames (Schur complement of the shared parameters)."""
    count, size = system.gradient.shape
    diagonal = np.einsum("fii->fi", system.frames)
    damped = system.frames + np.eye(size) * (damping * diagonal + _MINIMUM_INFORMATION)[:, None]
    inverse = np.linalg.inv(damped)
    inverse = 0.5 * (inverse + np.swapaxes(inverse, 1, 2))
    eliminated = inverse @ system.mixed
    reduced = system.shared * (1 + damping * np.eye(len(system.shared)))
    reduced = reduced - np.einsum("fap,faq->pq", system.mixed, eliminated)
    pull = system.shared_gradient - np.einsum("fap,fa->p", eliminated, system.gradient)
    own = np.linalg.inv(reduced) if len(reduced) else reduced
    moved = -own @ pull
    step = -products(inverse, system.gradient) - eliminated @ moved
    shared = np.zeros(chain.estimated.size)
    shared[chain.estimated.ravel()] = moved
    covariance = inverse + eliminated @ own @ np.swapaxes(eliminated, 1, 2)
    predicted = -float((system.gradient * step).sum() + system.shared_gradient @ moved)
    return ChainStep(step.reshape(count, -1, 6), shared.reshape(-1, PARAMETERS), covariance, predicted)
