"""Least squares over a chain of bones: a pose of every bone in every frame, and what all frames share of the joints."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Mask
from marey.geometry import rotations
from marey.markers.methods.chain import PARAMETERS, ChainJoint, JointPlace, gap

_HARDLY = 1e-3  # 1/rad2 or 1/m2: keeps in place what nothing sees


class Shape(NamedTuple):
    """One bone's markers: where they are on it, where they were seen, how far a coordinate is off."""

    places: Floats
    """(F, M, 3) in the bone [m]; 0 where not known."""
    points: Floats
    """(F, M, 3) in the laboratory [m]; 0 where missing."""
    used: Mask
    """(F, M)."""
    sd: Floats
    """(M,) [m]."""


class State(NamedTuple):
    """Poses and joints."""

    rotation: Floats
    """(F, S, 3, 3) laboratory from bone."""
    origin: Floats
    """(F, S, 3) [m]."""
    joints: tuple[JointPlace, ...]

    def moved(self, step: Floats, shared: Floats) -> "State":
        """Give the state after a step: (F, S, 6) turns about the bones' own axes and origins, (J, 10)."""
        return State(
            self.rotation @ rotations.exp(step[..., :3]), self.origin + step[..., 3:],
            tuple(place.moved(s) for place, s in zip(self.joints, shared, strict=True)),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """What is observed, and what is believed of the joints."""

    shapes: tuple[Shape, ...]
    """One a segment."""
    joints: tuple[ChainJoint, ...]
    ends: tuple[tuple[int, int], ...]
    """(parent, child) of each joint, as indices of segments."""
    known: tuple[Floats, Floats]
    """Rotation (K, S, 3, 3) and origin (K, S, 3) of the bones in the known postures."""
    estimated: Mask
    """(J, 10) the joints' parameters that are estimated."""
    start: tuple[JointPlace, ...]
    prior_sd: Floats
    """(J, 10) how far the parameters may be from their start."""
    known_sd: float
    """The standard deviation of a gap in a known posture [m], where a joint is held fast."""
    fast_m: float
    """The same over the trial."""


class System(NamedTuple):
    """The normal equations: frames (F, n, n), frames by shared (F, n, P), shared (P, P)."""

    frames: Floats
    gradient: Floats
    mixed: Floats
    shared: Floats
    shared_gradient: Floats
    cost: float


def marker_residuals(shape: Shape, rotation: Floats, origin: Floats) -> Floats:
    """Give model less seen (F, M, 3) [m]; 0 where a marker is not used."""
    model = np.einsum("fij,fmj->fmi", rotation, shape.places) + origin[:, None]
    return np.where(shape.used[..., None], model - shape.points, 0.0)


def marker_rows(shape: Shape, rotation: Floats) -> Floats:
    """Give how the markers move with the bone's turn and origin: (F, M, 3, 6)."""
    turn = -rotation[:, None] @ rotations.hat(shape.places)
    rows = np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], -1)
    return np.where(shape.used[..., None, None], rows, 0.0)


def build(chain: Chain, state: State) -> System:
    """Linearise all observations about a state."""
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
        gaps, wrt_bones, by_joint = _gap_at(chain, j, state.rotation, state.origin, place, chain.fast_m)
        index = np.concatenate([6 * end + np.arange(6) for end in chain.ends[j]])
        at = slice(PARAMETERS * j, PARAMETERS * (j + 1))
        frames[:, index[:, None], index] += np.swapaxes(wrt_bones, 1, 2) @ wrt_bones
        gradient[:, index] += (np.swapaxes(wrt_bones, 1, 2) @ gaps[..., None])[..., 0]
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
    return System(frames, gradient, mixed[..., keep], own[np.ix_(keep, keep)], own_gradient[keep], cost)


def _gap_at(
    chain: Chain, j: int, rotation: Floats, origin: Floats, place: JointPlace, fast_m: float
) -> tuple[Floats, Floats, Floats]:
    """Give the gap of one joint over frames or known postures; only estimated parameters count."""
    parent, child = chain.ends[j]
    residual, rows, shared = gap(
        chain.joints[j], place, (rotation[:, parent], origin[:, parent]), (rotation[:, child], origin[:, child]), fast_m
    )
    return residual, rows, shared * chain.estimated[j]


class Step(NamedTuple):
    """A solved step."""

    frames: Floats
    """(F, S, 6)."""
    shared: Floats
    """(J, 10)."""
    covariance: Floats
    """(F, 6 S, 6 S) of the poses, what is shared being estimated with them."""
    promised: float
    """By how much the cost would fall if all were linear."""


def descend(
    chain: Chain, state: State, *, most: int = 60, stop: float = 1e-7, enough: float = 1e-7
) -> tuple[State, Step]:
    """Find the state of least cost by damped Gauss-Newton.

    Args:
        chain: What is observed.
        state: Where to start.
        most: At most this many steps.
        stop: A shorter step [rad, m] ends the search,
        enough: and so does a step that lessens the cost by less than this share.

    Returns:
        The state, and an undamped step there for its covariance.
    """
    damping = 1e-9
    system = build(chain, state)
    for _ in range(most):
        step = solve(chain, system, damping)
        tried, there = _tried(chain, state, step, 1.0)
        if there.cost > system.cost - 0.5 * step.promised:
            # What the joints pull at bends as the bones turn: the plain step then goes about twice too far.
            half, there_half = _tried(chain, state, step, 0.5)
            if there_half.cost < there.cost:
                tried, there = half, there_half
        gained = system.cost - there.cost
        if gained >= 0:
            state, system, damping = tried, there, max(0.1 * damping, 1e-12)
        else:
            damping *= 10
        longest = max(np.abs(step.frames).max(), np.abs(step.shared).max(initial=0.0))
        if longest < stop or 0 <= gained < enough * system.cost or damping > 1e6:
            break
    return state, solve(chain, system, 0.0)


def _tried(chain: Chain, state: State, step: Step, share: float) -> tuple[State, System]:
    """Go a share of a step."""
    moved = state.moved(share * step.frames, share * step.shared)
    return moved, build(chain, moved)


def solve(chain: Chain, system: System, damping: float) -> Step:
    """Solve for a damped step by elimination of the frames (the Schur complement of what they share)."""
    count, size = system.gradient.shape
    diagonal = np.einsum("fii->fi", system.frames)
    damped = system.frames + np.eye(size) * (damping * diagonal + _HARDLY)[:, None]
    inverse = np.linalg.inv(damped)
    inverse = 0.5 * (inverse + np.swapaxes(inverse, 1, 2))
    eliminated = inverse @ system.mixed
    reduced = system.shared * (1 + damping * np.eye(len(system.shared)))
    reduced = reduced - np.einsum("fap,faq->pq", system.mixed, eliminated)
    pull = system.shared_gradient - np.einsum("fap,fa->p", eliminated, system.gradient)
    own = np.linalg.inv(reduced) if len(reduced) else reduced
    moved = -own @ pull
    step = -(inverse @ system.gradient[..., None])[..., 0] - eliminated @ moved
    shared = np.zeros(chain.estimated.size)
    shared[chain.estimated.ravel()] = moved
    covariance = inverse + eliminated @ own @ np.swapaxes(eliminated, 1, 2)
    promised = -float((system.gradient * step).sum() + system.shared_gradient @ moved)
    return Step(step.reshape(count, -1, 6), shared.reshape(-1, PARAMETERS), covariance, promised)
