"""Uncertainty of a jointed body's posture: its covariance, and the undetermined coordinates."""

from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.markers.kinematics.inverse_kinematics_setup import InverseKinematicsSetup

_RANK_TOLERANCE = 1e-9
"""Information below this ratio to the largest one counts as zero; numerical."""


class PostureEquations(NamedTuple):
    """The normal equations of one posture, solved."""

    moving: Integers
    """(n,) indices of the free coordinates: not locked, not dependent, not at a limit."""
    gain: Floats
    """(n, n) pseudoinverse of the information."""
    undetermined: Mask
    """(n,) True where there is no information."""
    held: Mask
    """(n,) True where tasks rather than markers determine the coordinate."""
    weight: Floats
    """(M,) weights; 0 where the marker is missing."""
    leverage: Floats
    """(M,) leverage of each marker: derivative of its modelled by its measured position, 0 to 1."""


class PostureUncertainty(NamedTuple):
    """The uncertainty of one posture."""

    sd: Floats
    """(N,) standard deviations [rad or m]."""
    determined: Mask
    """(N,) True where the markers determine the coordinate."""
    undetermined: Mask
    """(N,) True where nothing determines the coordinate."""
    bodies: Floats
    """(B, 6, 6) covariance of the bodies, as `BoneMotion.covariance`."""
    lost: Mask
    """(B,) True where a body depends on an undetermined coordinate."""


def solve_system(
    setup: InverseKinematicsSetup, observed: Floats, values: Floats, jacobian: Floats, slopes: Floats
) -> PostureEquations:  # fmt: skip
    """Invert the information of markers and tasks on a posture.

    Args:
        setup: The body, its markers and their weights.
        observed: (M, 3) the markers [m]; NaN where missing.
        values: (N,) the posture.
        jacobian: (M, 3, N) of the markers.
        slopes: (N, N) derivatives of the coordinates by those that are not coupled.
    """
    weight = np.where(np.isfinite(observed[:, 0]), setup.weight, 0.0)
    task = np.where(setup.task_weight > 0, setup.task_weight * weight.sum(), 0.0)
    at_limit = (values <= setup.lower) | (values >= setup.upper)
    moving = np.flatnonzero(setup.model.free & ~at_limit)
    rows = (np.sqrt(weight)[:, None, None] * jacobian[:, :, moving]).reshape(-1, len(moving))
    tasks = (slopes[:, moving].T * task) @ slopes[:, moving]
    size, direction = np.linalg.eigh(rows.T @ rows + tasks)
    there = size > _RANK_TOLERANCE * max(size[-1], 0.0) if len(size) else np.zeros(0, bool)
    gain = (direction[:, there] / size[there]) @ direction[:, there].T
    undetermined = (direction[:, ~there] ** 2).sum(1) > 1e-6
    held = (gain * tasks.T).sum(1) > 1 - setup.settings.marker_share
    own = ((rows @ gain) * rows).sum(1).reshape(-1, 3).sum(1) / 3
    return PostureEquations(moving, gain, undetermined, held, weight, own)


def marker_variance(weight: Floats, residuals: Floats, leverage: Floats) -> Floats:
    """Estimate each marker's variance (M,) [m2] of a coordinate from its residuals.

    Residuals are smaller than the marker's error according to its leverage. A marker's variance is shrunk towards the
    one implied by its weight, with the weight of one frame.

    Args:
        weight: (M,) weights of the markers.
        residuals: (F, M, 3) [m]; NaN where missing.
        leverage: (F, M) leverage of the markers.

    Returns:
        (M,) variances [m2].
    """
    squares = (residuals**2).sum(-1)
    seen = np.isfinite(squares)
    total, spare = np.where(seen, squares, 0.0).sum(0), np.where(seen, 3 * (1 - leverage), 0.0).sum(0)
    unit = (weight * total).sum() / spare.sum() if spare.sum() > 1e-6 else np.nan
    return np.asarray((total + 3 * unit / weight) / (spare + 3))


def posterior(
    setup: InverseKinematicsSetup,
    system: PostureEquations,
    variance: Floats,
    jacobian: Floats,
    moved: Floats,
    slopes: Floats,
) -> PostureUncertainty:
    """Compute the uncertainty of a posture.

    Args:
        setup: The body.
        system: Solved equations of the frame.
        variance: (M,) variances of the markers [m2].
        jacobian: (M, 3, N) derivatives of the markers.
        moved: (B, 6, N) derivatives of the bodies' poses by the coordinates.
        slopes: (N, N) derivatives of the coordinates by those that are not coupled.

    Returns:
        Standard deviations and covariances.
    """
    count, moving = len(slopes), system.moving
    rows = ((system.weight * np.sqrt(variance))[:, None, None] * jacobian[:, :, moving]).reshape(-1, len(moving))
    drawn = rows @ system.gain
    covariance = np.zeros((count, count))
    covariance[np.ix_(moving, moving)] = drawn.T @ drawn
    own_sd = np.sqrt(np.diagonal(covariance)[moving])
    vague = system.undetermined | (~system.held & (own_sd > setup.settings.largest_sd))
    unknown, held = np.zeros(count, bool), setup.model.free & ~np.isin(np.arange(count), moving)
    unknown[moving], held[moving] = vague, system.held & ~vague
    hangs = slopes != 0
    undetermined, not_seen = hangs @ unknown, hangs @ (unknown | held)
    locked = np.array([c.locked for c in setup.model.coordinates])
    sd = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T))
    sd[not_seen] = np.nan
    bodies = moved @ covariance @ moved.transpose(0, 2, 1)
    moves = np.abs(moved).max(1, initial=0.0) > 1e-12
    bodies[moves @ (unknown | held)] = np.nan
    return PostureUncertainty(sd, ~not_seen & ~locked, undetermined, bodies, moves @ unknown)
