"""Rotations over time: angular accelerations, smoothed paths, and paths with mirrored depth."""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.core.block_banded import solve_banded

MIRROR = np.diag([1.0, 1.0, -1.0])
"""Reflection in depth, which one orthographic camera cannot detect."""
LONGEST_TURN = 0.3
"""Gauss-Newton steps are shortened so that no rotation vector component exceeds this [rad]. Chosen by hand; results
were not measured against other values."""
_STEPS = 30
"""Largest number of Gauss-Newton steps of a smoothed path; a limit on time."""


def accelerations(rotation: Floats) -> Floats:
    """Compute the change of the rotation vector from frame to frame (F - 2, 3) [rad], in the camera's axes."""
    turns = rotations.log(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2))
    return np.asarray(turns[1:] - turns[:-1])


def acceleration_jacobians(rotation: Floats) -> tuple[Floats, Floats, Floats]:
    """Compute the derivatives (F - 2, 3, 3) of accelerations by left rotations of their three frames.

    With r_f = log(R_f+1 R_f'), d r_f = w_f+1 - R_f+1 R_f' w_f to first order in r.
    """
    step = rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)
    return step[:-1], -(np.eye(3) + step[1:]), np.broadcast_to(np.eye(3), (len(rotation) - 2, 3, 3))


def add_acceleration_penalty(
    diagonal: Floats, first: Floats, second: Floats, right: Floats, rotation: Floats, precision: float
) -> None:
    """Add squared angular accelerations to normal equations whose first three unknowns per frame are the rotation.

    Args:
        diagonal: (F, D, D) blocks as in `solve_banded`; changed in place, as are the other blocks.
        first: (F, D, D) blocks that couple a frame with the next.
        second: (F, D, D) blocks that couple a frame with the next but one.
        right: (F, D) right-hand side, minus the gradient.
        rotation: (F, 3, 3).
        precision: Inverse variance of an acceleration [1/rad2].
    """
    value, jacobians = accelerations(rotation), acceleration_jacobians(rotation)
    a, b, c = (np.swapaxes(jacobian, 1, 2) * precision for jacobian in jacobians)
    for k, transposed in enumerate((a, b, c)):
        frames = slice(k, len(rotation) - 2 + k)
        diagonal[frames, :3, :3] += transposed @ jacobians[k]
        right[frames, :3] -= np.einsum("fij,fj->fi", transposed, value)
    first[:-2, :3, :3] += a @ jacobians[1]
    first[1:-1, :3, :3] += b @ jacobians[2]
    second[:-2, :3, :3] += a @ jacobians[2]


def smoothed_path(rotation: Floats, span: float) -> Floats:
    """Smooth a path of rotations, minimising its squared distance plus its weighted squared accelerations.

    Args:
        rotation: (F, 3, 3).
        span: Weight of the accelerations. Oscillations with periods above about 6 times its fourth root, in frames,
            are kept.

    Returns:
        Smoothed rotations (F, 3, 3).
    """
    if span == 0 or len(rotation) < 3:
        return rotation
    frames, path, weight = len(rotation), rotation, min(span, 1.0)
    for _ in range(_STEPS):
        weight = min(span, 10 * weight)
        diagonal = np.tile(np.eye(3), (frames, 1, 1))
        first, second = np.zeros((frames, 3, 3)), np.zeros((frames, 3, 3))
        right = rotations.log(rotation @ np.swapaxes(path, 1, 2))
        add_acceleration_penalty(diagonal, first, second, right, path, weight)
        step = solve_banded(diagonal, first, second, right)[0]
        longest = float(np.abs(step).max())
        path = rotations.exp(step * min(1.0, LONGEST_TURN / max(longest, 1e-300))) @ path
        if weight == span and longest < 1e-5:
            break
    return np.asarray(path)


def mirrored_after(rotation: Floats, frame: int) -> Floats:
    """Mirror depth from a frame on, leaving that frame unchanged; the tracks of a rigid object stay the same."""
    out = rotation.copy()
    out[frame:] = MIRROR @ rotation[frame:] @ (rotation[frame].T @ MIRROR @ rotation[frame])
    return out
