"""Uncertainty of slow rotations that could belong to the camera or to the object.

One camera distinguishes the two only by their effect on the shapes: with a wrong camera path the object appears to
rotate slowly as a whole, which needs an additional deformation mode. Such a rotation is limited by the cost of that
mode, and by the variance of the camera's angular acceleration.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.core.completion import singular_vectors
from marey.nonrigid.core.deforming_model import COST_PER_MODE_POINT


@dataclass(frozen=True, kw_only=True)
class SlowTurnSettings:
    """Settings of the uncertainty of slow rotations."""

    curves: int = 12
    """Number of time courses of a rotation about each axis: a linear one, and cosines of up to 5.5 periods. Chosen by
    hand; results were not measured against other values."""
    correlation: float = 2.2
    """The cost of modes is divided by this times the number of points P. `basis_cost` takes the P points as
    independent, but points of one object move alike, and all together count about as one. Chosen by hand; results were
    not measured against other values."""
    least_share: float = 1e-9
    """Singular vectors with a smaller share of the variance are ignored; a numerical threshold."""


def slow_turn_covariance(
    shapes: Floats, noise: float, acceleration_variance: float, settings: SlowTurnSettings = SlowTurnSettings()
) -> Floats:
    """Compute the covariance of slow rotations that could be attributed to the object or to the camera.

    The cost of modes of squared sizes d^2 is the sum of log(1 + 2 d^2 / (3 P noise^2)) of `basis_cost`, here to second
    order about the given shapes; the rotation's accelerations have the variance `acceleration_variance`.

    Args:
        shapes: (F, 3, P) in the object's frame, centred.
        noise: Standard deviation below which a mode costs nothing, in the shapes' unit.
        acceleration_variance: Variance of the camera's angular acceleration [rad2].
        settings: Time courses and weights.

    Returns:
        (F, 3, 3) about the object's axes [rad2], without a rotation common to all frames.
    """
    frames, _, points = shapes.shape
    curves = _curves(frames, settings.curves)
    left = (shapes - shapes.mean(0)).reshape(frames, -1)
    turned = rotations.hat(np.eye(3))[:, None] @ shapes
    changes = (curves[:, None, :, None, None] * turned).reshape(3 * len(curves), frames, -1)
    changes = changes - changes.mean(1, keepdims=True)
    precision = _curvature(left, changes, 2 / (3 * points * noise**2), settings.least_share)
    precision = precision * COST_PER_MODE_POINT / settings.correlation
    bends = np.diff(curves, 2)
    precision += np.kron(bends @ bends.T, np.eye(3)) / acceleration_variance
    # Prior of one radian, for rotations that neither limits.
    covariance = np.linalg.inv(precision + np.eye(len(precision))).reshape(len(curves), 3, len(curves), 3)
    centred = curves - curves.mean(1, keepdims=True)
    return np.asarray(np.einsum("jf,jakb,kf->fab", centred, covariance, centred, optimize=True))


def turned_covariance(covariance: Floats, shapes: Floats) -> Floats:
    """Compute the variance (F, 3, P) of shapes (F, 3, P) whose rotation vector has covariance (F, 3, 3)."""
    moved = rotations.hat(np.eye(3)) @ shapes[:, None]
    return np.asarray(np.einsum("fkip,fkl,flip->fip", moved, covariance, moved, optimize=True))


def _curves(frames: int, count: int) -> Floats:
    """Compute time courses (count, F) between -1 and 1."""
    time = (np.arange(frames) + 0.5) / frames
    return np.stack([2 * time - 1, *(np.cos(np.pi * k * time) for k in range(1, count))])


def _curvature(left: Floats, changes: Floats, weight: float, least_share: float) -> Floats:
    """Compute the positive part of the second derivatives of log det(1 + weight X X') by changes (n, F, m) of X (F, m).

    A change has a cost as far as it lies outside the row and column spaces of X.
    """
    u, d, vt = singular_vectors(left)
    share = weight * d**2 / (1 + weight * d**2)
    kept = share > least_share
    u, vt, share = u[:, kept], vt[kept], share[kept, None]
    one = np.stack([change - u @ (share * (u.T @ change)) for change in changes]).reshape(len(changes), -1)
    other = np.stack([change - (change @ vt.T) @ (share * vt) for change in changes]).reshape(len(changes), -1)
    curvature = 2 * weight * one @ other.T
    return np.asarray(0.5 * (curvature + curvature.T))
