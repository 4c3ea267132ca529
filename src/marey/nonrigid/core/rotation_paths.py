"""Rotations over time: how unsteadily they change, steadier paths, and depth that was taken for its mirror image."""

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.nonrigid.core.block_banded import solve_banded

MIRROR = np.diag([1.0, 1.0, -1.0])
LONGEST_TURN = 0.3
STEPS = 30


def accelerations(rotation: Floats) -> Floats:
    """Give the change of the turn from frame to frame (F - 2, 3) [rad], in the camera's axes."""
    turns = rotations.log(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2))
    return np.asarray(turns[1:] - turns[:-1])


def acceleration_jacobians(rotation: Floats) -> tuple[Floats, Floats, Floats]:
    """Give the derivatives (F - 2, 3, 3) of an acceleration by turns of its three frames, each from the left.

    With the turn r_f = log(R_f+1 R_f'), d r_f = w_f+1 - R_f+1 R_f' w_f to first order in r.
    """
    step = rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)
    return step[:-1], -(np.eye(3) + step[1:]), np.broadcast_to(np.eye(3), (len(rotation) - 2, 3, 3))


def add_steadiness(
    diagonal: Floats, first: Floats, second: Floats, right: Floats, rotation: Floats, precision: float
) -> None:
    """Add squared accelerations times a precision to normal equations whose first three unknowns a frame are the turn.

    Args:
        diagonal: (F, D, D), with `first`, `second` and `right` (F, D) as in `solve_banded`; changed.
        first: see there.
        second: see there.
        right: see there; minus the gradient.
        rotation: (F, 3, 3).
        precision: 1 over the variance of an acceleration [1/rad2].
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


def steadier(rotation: Floats, span: float) -> Floats:
    """Find the path whose squared distance from the rotations and weighed squared accelerations sum to the least.

    Args:
        rotation: (F, 3, 3).
        span: the weight of the accelerations; slower swings than about 6 times its fourth root in frames are kept.

    Returns:
        (F, 3, 3).
    """
    if span == 0 or len(rotation) < 3:
        return rotation
    frames, path, weight = len(rotation), rotation, min(span, 1.0)
    for _ in range(STEPS):
        weight = min(span, 10 * weight)
        diagonal = np.tile(np.eye(3), (frames, 1, 1))
        first, second = np.zeros((frames, 3, 3)), np.zeros((frames, 3, 3))
        right = rotations.log(rotation @ np.swapaxes(path, 1, 2))
        add_steadiness(diagonal, first, second, right, path, weight)
        step = solve_banded(diagonal, first, second, right)[0]
        longest = float(np.abs(step).max())
        path = rotations.exp(step * min(1.0, LONGEST_TURN / max(longest, 1e-300))) @ path
        if weight == span and longest < 1e-5:
            break
    return np.asarray(path)


def mirrored_after(rotation: Floats, frame: int) -> Floats:
    """Mirror depth from a frame on, that frame itself unchanged: the other way to see the tracks of something rigid."""
    out = rotation.copy()
    out[frame:] = MIRROR @ rotation[frame:] @ (rotation[frame].T @ MIRROR @ rotation[frame])
    return out
