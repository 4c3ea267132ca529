"""What markers determine of a jointed body's posture: its covariance, and what stays open."""

from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.jointed_kinematics import coordinate_slopes

_OPEN = 0.5  # rad or m; a coordinate that is not known better than this is open
_SEEN = 0.5  # of what fixes a coordinate must come from markers, else a task holds it
_NOTHING = 1e-9  # of the greatest information: none at all


class Setup(NamedTuple):
    """What stays the same from frame to frame."""

    model: JointedBody
    labels: tuple[str, ...]
    body: Integers
    """(M,) the body of each marker, -1 for the ground."""
    place: Floats
    """(M, 3) [m]."""
    weight: Floats
    """(M,)."""
    task_weight: Floats
    """(N,) against the markers' weighted mean."""
    target: Floats
    """(F, N) [rad or m]; 0 where there is no task."""
    lower: Floats
    upper: Floats
    """(N,) limits [rad or m]."""


class System(NamedTuple):
    """The normal equations of one posture, solved."""

    moving: Integers
    """(n,) the coordinates that were free to move: not locked, not following, not at a limit."""
    gain: Floats
    """(n, n) inverse of the information; the part that there is where it has no inverse."""
    open: Mask
    """(n,) true where there is no information."""
    held: Mask
    """(n,) true where tasks and not markers say most of the coordinate."""
    weight: Floats
    """(M,) 0 where the marker is missing."""
    leverage: Floats
    """(M,) how far each marker's own place draws the model's: 0 not at all, 1 all the way."""


class Known(NamedTuple):
    """What is known of one posture."""

    sd: Floats
    """(N,) [rad or m]."""
    determined: Mask
    """(N,)."""
    open: Mask
    """(N,) true where nothing fixes the coordinate."""
    bodies: Floats
    """(B, 6, 6)."""
    lost: Mask
    """(B,) true where a body hangs on a coordinate that is open."""


def solve_system(setup: Setup, observed: Floats, values: Floats, jacobian: Floats) -> System:
    """Invert the information that markers and tasks have of a posture.

    Args:
        setup: The body, its markers and their weights.
        observed: (M, 3) the markers [m]; NaN where missing.
        values: (N,) the posture.
        jacobian: (M, 3, N) of the markers.
    """
    weight = np.where(np.isfinite(observed[:, 0]), setup.weight, 0.0)
    slopes = coordinate_slopes(setup.model, values)
    task = np.where(setup.task_weight > 0, setup.task_weight * weight.sum(), 0.0)
    at_limit = (values <= setup.lower) | (values >= setup.upper)
    moving = np.flatnonzero(setup.model.free & ~at_limit)
    rows = (np.sqrt(weight)[:, None, None] * jacobian[:, :, moving]).reshape(-1, len(moving))
    tasks = (slopes[:, moving].T * task) @ slopes[:, moving]
    size, direction = np.linalg.eigh(rows.T @ rows + tasks)
    there = size > _NOTHING * max(size[-1], 0.0) if len(size) else np.zeros(0, bool)
    gain = (direction[:, there] / size[there]) @ direction[:, there].T
    open_ = (direction[:, ~there] ** 2).sum(1) > 1e-6
    held = (gain * tasks.T).sum(1) > 1 - _SEEN
    own = ((rows @ gain) * rows).sum(1).reshape(-1, 3).sum(1) / 3
    return System(moving, gain, open_, held, weight, own)


def marker_variance(weight: Floats, residuals: Floats, leverage: Floats) -> Floats:
    """Give each marker's variance (M,) [m2] along one axis, from what its residuals leave.

    A residual is smaller than the marker's error by as much as the marker drew the model (its leverage). A marker's
    variance is drawn towards what its weight says, as much as one frame counts.

    Args:
        weight: (M,) of the markers.
        residuals: (F, M, 3) [m]; NaN where missing.
        leverage: (F, M).
    """
    squares = (residuals**2).sum(-1)
    seen = np.isfinite(squares)
    total, spare = np.where(seen, squares, 0.0).sum(0), np.where(seen, 3 * (1 - leverage), 0.0).sum(0)
    unit = (weight * total).sum() / spare.sum() if spare.sum() > 1e-6 else np.nan
    return np.asarray((total + 3 * unit / weight) / (spare + 3))


def posterior(setup: Setup, system: System, variance: Floats, jacobian: Floats, moved: Floats, values: Floats) -> Known:
    """Tell what the markers determine of a posture, and how well.

    Args:
        setup: The body.
        system: Its solved equations.
        variance: (M,) of the markers [m2].
        jacobian: (M, 3, N) of the markers.
        moved: (B, 6, N) how the bodies move with the coordinates.
        values: (N,) the posture.
    """
    count, moving = len(values), system.moving
    rows = ((system.weight * np.sqrt(variance))[:, None, None] * jacobian[:, :, moving]).reshape(-1, len(moving))
    drawn = rows @ system.gain
    covariance = np.zeros((count, count))
    covariance[np.ix_(moving, moving)] = drawn.T @ drawn
    own_sd = np.sqrt(np.diagonal(covariance)[moving])
    vague = system.open | (~system.held & (own_sd > _OPEN))
    unknown, held = np.zeros(count, bool), setup.model.free & ~np.isin(np.arange(count), moving)
    unknown[moving], held[moving] = vague, system.held & ~vague
    slopes = coordinate_slopes(setup.model, values)
    hangs = slopes != 0
    open_, not_seen = hangs @ unknown, hangs @ (unknown | held)
    locked = np.array([c.locked for c in setup.model.coordinates])
    sd = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T))
    sd[not_seen] = np.nan
    bodies = moved @ covariance @ moved.transpose(0, 2, 1)
    moves = np.abs(moved).max(1, initial=0.0) > 1e-12
    bodies[moves @ (unknown | held)] = np.nan
    return Known(sd, ~not_seen & ~locked, open_, bodies, moves @ unknown)
