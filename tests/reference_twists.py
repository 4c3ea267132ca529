"""Exponential, logarithm and transformation of twists: the definitions with which the geometry is compared."""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform


def exp(twist: Floats) -> Floats:
    """Convert twists to rigid motions ([Rosenhahn2006] eq. (5) and (8)).

    Unlike the paper, the translation is the left Jacobian times v, which equals eq. (8) for every angle and remains
    accurate as the angle vanishes.

    Args:
        twist: (..., 6) as (v, w).

    Returns:
        (..., 4, 4).
    """
    twist = np.asarray(twist, float)
    v, w = twist[..., :3], twist[..., 3:]
    motion = np.zeros((*twist.shape[:-1], 4, 4))
    motion[..., :3, :3] = rotations.exp(w)
    motion[..., :3, 3] = (rotations.left_jacobian(w) @ v[..., None])[..., 0]
    motion[..., 3, 3] = 1.0
    return motion


def log(motion: Floats) -> Floats:
    """Convert rigid motions to twists whose angle is at most pi.

    Args:
        motion: (..., 4, 4).

    Returns:
        (..., 6) as (v, w).
    """
    w = rotations.log(motion[..., :3, :3])
    v = (rotations.inverse_left_jacobian(w) @ motion[..., :3, 3:])[..., 0]
    return np.concatenate([v, w], -1)


def adjoint(b_from_a: RigidTransform) -> Floats:
    """Return the matrix (6, 6) that transforms twists (v, w) from a to b."""
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = b_from_a.rotation
    matrix[:3, 3:] = rotations.hat(b_from_a.translation) @ b_from_a.rotation
    return matrix
