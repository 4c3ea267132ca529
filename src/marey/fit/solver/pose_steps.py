"""Gauss-Newton steps of a pose on moments, in one kernel."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, frozen
from marey.body.articulation.kinematics import pose_segments, turned
from marey.body.articulation.skeleton import Skeleton
from marey.compiled.kernels import kernel
from marey.fit.solver.normal_equations import assemble
from marey.geometry.rotations import inverse_left_jacobian_of, turn_between
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, NearPose

LONGEST_STEP_RAD = 0.5
"""Largest change of an angle in one Gauss-Newton step [rad]. Chosen by hand; other values were not measured."""

DAMPING = 1e-9
"""Added to the diagonal of the normal equations, as a share of its mean: above rounding, below any prior."""


class PackedPriors(NamedTuple):
    """Priors of a pose as arrays for the kernel; a weight of zero stands for no prior."""

    limits: Floats
    """(D - 6, 2) [rad]."""
    limit_weight: float
    """Weight of an angle's excess over its limit [1/rad2]."""
    habit: Floats
    """(D - 6,) usual joint angles [rad]."""
    habit_weight: Floats
    """(D - 6,) [1/rad2]."""
    translation: Floats
    """(3,) of the predicted pose [m]."""
    rotation: Floats
    """(3, 3) of the predicted pose."""
    angles: Floats
    """(D - 6,) of the predicted pose [rad]."""
    near_weight: Floats
    """(D,) [1/m2, 1/rad2]."""

    @staticmethod
    def of(skeleton: Skeleton, others: Sequence[Observation]) -> "PackedPriors | None":
        """Pack priors, at most one of each kind; return None if there is any other observation."""
        kinds = {type(other): other for other in others}
        if len(kinds) < len(others) or not kinds.keys() <= {JointLimits, Habit, NearPose}:
            return None
        limits, habit, near = (kinds.get(kind) for kind in (JointLimits, Habit, NearPose))
        mean, sd = skeleton.habit
        share = 1.0 / habit.sigma**2 if habit is not None else 0.0
        pose = near.pose if isinstance(near, NearPose) else None
        return PackedPriors(
            limits=skeleton.limits, limit_weight=1.0 / limits.sigma**2 if limits is not None else 0.0,
            habit=mean, habit_weight=share / sd**2,
            translation=frozen(np.zeros(3)) if pose is None else pose.translation,
            rotation=frozen(np.eye(3)) if pose is None else pose.rotation,
            angles=frozen(np.zeros(len(mean))) if pose is None else pose.angles,
            near_weight=1.0 / near.spread**2 if isinstance(near, NearPose) else np.zeros(len(skeleton)),
        )  # fmt: skip


@kernel
def descend(
    skeleton, joints, rotation, translation, angles, pairs, products, linear, known, steps, stop
):  # fmt: skip
    """Take Gauss-Newton steps until one is shorter than `stop`; see `pose_solver.solve_pose`.

    Args:
        skeleton: `PackedSkeleton`.
        joints: (S, 3) at rest.
        rotation: (3, 3) of the root at the start.
        translation: (3,) of the root at the start.
        angles: (D - 6,) at the start.
        pairs: Field of `Moments`.
        products: Field of `Moments`.
        linear: Field of `Moments`.
        known: `PackedPriors`.
        steps: Largest number of steps.
        stop: Length of the step that ends the iteration [m, rad].

    Returns:
        Rotation, translation and angles, the information (D, D) at the last linearisation, and whether
        every system could be solved.
    """
    degrees = 6 + angles.shape[0]
    hessian, gradient = np.zeros((degrees, degrees)), np.zeros(degrees)
    factor, change = np.zeros((degrees, degrees)), np.zeros(degrees)
    rotation, translation, angles = rotation.copy(), translation.copy(), angles.copy()
    for _ in range(steps):
        turns, origin, axes = pose_segments(
            skeleton.parents, skeleton.coordinate_segment, skeleton.axes, joints, rotation, translation, angles
        )
        hessian[:], gradient[:] = 0.0, 0.0
        assemble(
            skeleton.parents, skeleton.coordinate_segment, turns, origin, axes, pairs, products, linear,
            hessian, gradient,
        )  # fmt: skip
        add_priors(known, rotation, translation, angles, hessian, gradient)
        if not solve_step_into(hessian, gradient, factor, change):
            return rotation, translation, angles, hessian, False
        rotation = turned(rotation, change[3:6])
        translation = translation + change[:3]
        angles = angles + change[6:]
        if np.abs(change).max() < stop:
            break
    return rotation, translation, angles, hessian, True


@kernel
def add_priors(known, rotation, translation, angles, hessian, gradient):
    """Add the priors to the normal equations, as `pose_solver.add_dense` does."""
    for i in range(angles.shape[0]):
        low, high = known.limits[i, 0], known.limits[i, 1]
        beyond = min(angles[i] - low, 0.0) + max(angles[i] - high, 0.0)
        weight = known.habit_weight[i] + known.near_weight[6 + i]
        gradient[6 + i] += known.habit_weight[i] * (angles[i] - known.habit[i]) + known.limit_weight * beyond
        gradient[6 + i] += known.near_weight[6 + i] * (angles[i] - known.angles[i])
        hessian[6 + i, 6 + i] += weight + (known.limit_weight if beyond != 0.0 else 0.0)
    away = turn_between(known.rotation, rotation)
    slope = inverse_left_jacobian_of(away)
    for a in range(3):
        hessian[a, a] += known.near_weight[a]
        gradient[a] += known.near_weight[a] * (translation[a] - known.translation[a])
        for b in range(3):
            weighted = known.near_weight[3 + b] * slope[b, a]
            gradient[3 + a] += weighted * away[b]
            for c in range(3):
                hessian[3 + a, 3 + c] += weighted * slope[b, c]


@kernel(fastmath=True)
def solve_step_into(hessian, gradient, factor, change):
    """Solve for a Gauss-Newton step by Cholesky's method, as `pose_solver.solve_step`; return False if that fails."""
    degrees = hessian.shape[0]
    damping = 0.0
    for i in range(degrees):
        damping += DAMPING * hessian[i, i] / degrees
    for i in range(degrees):
        own = factor[i]
        for j in range(i + 1):
            other = factor[j]
            t = hessian[i, j]
            for k in range(j):
                t -= own[k] * other[k]
            if j < i:
                own[j] = t / other[j]
            elif t + damping > 0.0:
                own[i] = np.sqrt(t + damping)
            else:
                return False
    for i in range(degrees):
        t = -gradient[i]
        for k in range(i):
            t -= factor[i, k] * change[k]
        change[i] = t / factor[i, i]
    for i in range(degrees - 1, -1, -1):
        change[i] /= factor[i, i]
        for k in range(i):
            change[k] -= factor[i, k] * change[i]
    longest = np.abs(change[3:]).max()
    if longest > LONGEST_STEP_RAD:
        change *= LONGEST_STEP_RAD / longest
    return True
