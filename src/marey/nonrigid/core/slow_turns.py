"""How surely a slow turn is the camera's and not the object's own.

One camera cannot tell the two apart but by what they make of the shapes: with the wrong camera path the object seems to
turn as a whole, slowly, which needs one more displacement. How much simpler the shapes are with
the path that was chosen, and how unsteady a camera is believed to be, is all that limits such a turn.
"""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.core.completion import singular_vectors
from marey.nonrigid.core.deforming_model import PRICE_A_POINT

CURVES = 12
"""Courses over time that a turn about each axis may take: one even, the others cosines of up to 5.5 periods."""
ALIKE = 2.2
"""The price of displacements is divided by this times P: `basis_cost` takes each of P points for itself, but points of
one object move alike, and all together tell about as much as one."""
NOTHING = 1e-9
"""Singular vectors that weigh less are left out."""


def slow_turn_covariance(shapes: Floats, noise: float, unsteadiness: float) -> Floats:
    """Give the covariance of slow turns that the object and the camera may share otherwise.

    The price of displacements of squared sizes d^2 is the sum of log(1 + 2 d^2 / (3 P noise^2)) of `basis_cost`, here
    to second order about the shapes that were found; the turn's accelerations have the variance `unsteadiness`.

    Args:
        shapes: (F, 3, P) in the object's frame, centred.
        noise: standard deviation below which a displacement costs nothing, in the shapes' unit.
        unsteadiness: variance of the camera's acceleration [rad2].

    Returns:
        (F, 3, 3) about the object's axes [rad2], one turn that all frames share taken out.
    """
    frames, _, points = shapes.shape
    curves = _curves(frames)
    left = (shapes - shapes.mean(0)).reshape(frames, -1)
    turned = rotations.hat(np.eye(3))[:, None] @ shapes
    changes = (curves[:, None, :, None, None] * turned).reshape(3 * len(curves), frames, -1)
    changes = changes - changes.mean(1, keepdims=True)
    precision = _curvature(left, changes, 2 / (3 * points * noise**2)) * PRICE_A_POINT / ALIKE
    bends = np.diff(curves, 2)
    precision += np.kron(bends @ bends.T, np.eye(3)) / unsteadiness
    # A turn of a radian is as little as is believed where neither limits it.
    covariance = np.linalg.inv(precision + np.eye(len(precision))).reshape(len(curves), 3, len(curves), 3)
    centred = curves - curves.mean(1, keepdims=True)
    return np.asarray(np.einsum("jf,jakb,kf->fab", centred, covariance, centred, optimize=True))


def turned_covariance(covariance: Floats, shapes: Floats) -> Floats:
    """Give the variance (F, 3, P) of coordinates of shapes (F, 3, P) whose turn has a covariance (F, 3, 3)."""
    moved = rotations.hat(np.eye(3)) @ shapes[:, None]
    return np.asarray(np.einsum("fkip,fkl,flip->fip", moved, covariance, moved, optimize=True))


def _curves(frames: int) -> Floats:
    """Give courses over time (CURVES, F) between -1 and 1."""
    time = (np.arange(frames) + 0.5) / frames
    return np.stack([2 * time - 1, *(np.cos(np.pi * k * time) for k in range(1, CURVES))])


def _curvature(left: Floats, changes: Floats, weight: float) -> Floats:
    """Give the second derivatives of log det(1 + weight X X') by changes (n, F, m) of X (F, m), their positive part.

    A change costs as far as it lies outside the rows and columns that X has already.
    """
    u, d, vt = singular_vectors(left)
    share = weight * d**2 / (1 + weight * d**2)
    kept = share > NOTHING
    u, vt, share = u[:, kept], vt[kept], share[kept, None]
    one = np.stack([change - u @ (share * (u.T @ change)) for change in changes]).reshape(len(changes), -1)
    other = np.stack([change - (change @ vt.T) @ (share * vt) for change in changes]).reshape(len(changes), -1)
    curvature = 2 * weight * one @ other.T
    return np.asarray(0.5 * (curvature + curvature.T))
