"""Kernels of inverse kinematics: one posture by weighted least squares over all markers."""

import numpy as np

from marey.body.articulation.jointed_kinematics import follow, new_state, place_bodies, point_on_body, point_rows
from marey.compiled.kernel_copies import copy_row
from marey.compiled.kernels import kernel

_LONGEST = 0.6
"""Longest step of a coordinate [rad or m]; longer ones are scaled down. Chosen by hand."""
_FLOOR = 1e-10
"""Information added to every coordinate as a ratio to the markers' weight, which keeps unobserved coordinates in place;
numerical."""


@kernel
def evaluate(packed, markers, tasks, values, variable, slope, state, hessian, gradient):
    """Compute the cost of a posture and, unless hessian is empty, its derivatives.

    Args:
        packed: The body.
        markers: Body (M,), position (M, 3), weight (M,), measured position (M, 3) with NaN where missing.
        tasks: Weight (N,) relative to the markers' mean, target value (N,).
        values: (N,) the posture; dependent coordinates are overwritten.
        variable: (N,) output: the coordinate on which each one depends.
        slope: (N,) output: its derivative by that coordinate.
        state: Rotation, origin, axes, points, slopes, as `place_bodies` fills them.
        hessian: (N, N) or (0, 0), output.
        gradient: (N,) output.

    Returns:
        The cost, and the sum of the weights of the visible markers.
    """
    body, place, weight, observed = markers
    task_weight, target = tasks
    rotation, origin, axes, points, motion_slope = state
    follow(packed, values, variable, slope)
    place_bodies(packed, values, rotation, origin, axes, points, motion_slope)
    derive = hessian.shape[0] > 0
    count = packed.source.shape[0]
    if derive:
        hessian[:] = 0.0
        gradient[:] = 0.0
    rows = np.empty((count, 3))
    used = np.empty(count, np.int64)
    cost = total = 0.0
    for m in range(body.shape[0]):
        w = weight[m]
        if not np.isfinite(observed[m, 0]) or w <= 0.0:
            continue
        total += w
        p = point_on_body(rotation, origin, body[m], place[m])
        r = (p[0] - observed[m, 0], p[1] - observed[m, 1], p[2] - observed[m, 2])
        cost += w * (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        if derive:
            number = point_rows(packed, body[m], p, axes, points, motion_slope, variable, slope, rows, used)
            for i in range(number):
                a = used[i]
                gradient[a] += w * (rows[a, 0] * r[0] + rows[a, 1] * r[1] + rows[a, 2] * r[2])
                for j in range(i + 1):
                    b = used[j]
                    product = w * (rows[a, 0] * rows[b, 0] + rows[a, 1] * rows[b, 1] + rows[a, 2] * rows[b, 2])
                    hessian[a, b] += product
                    if a != b:
                        hessian[b, a] += product
    for c in range(count):
        if task_weight[c] > 0.0:
            w = task_weight[c] * total
            away = values[c] - target[c]
            cost += w * away * away
            if derive:
                a = variable[c]
                gradient[a] += w * slope[c] * away
                hessian[a, a] += w * slope[c] * slope[c]
    return cost, total


@kernel
def descend(packed, markers, tasks, free, lower, upper, values, most, stop):
    """Minimise the cost from values (N,), which are overwritten, by damped Gauss-Newton within the limits.

    A coordinate at a limit with a gradient that points beyond it is fixed for the step.

    Returns:
        The cost, and whether a step shorter than stop ended the iteration.
    """
    count = values.shape[0]
    state = new_state(packed)
    variable, slope = np.empty(count, np.int64), np.empty(count)
    hessian, gradient = np.empty((count, count)), np.empty(count)
    nothing = np.empty((0, 0))
    for c in range(count):
        if free[c]:
            values[c] = min(max(values[c], lower[c]), upper[c])
    cost, total = evaluate(packed, markers, tasks, values, variable, slope, state, hessian, gradient)
    damping = 1e-8
    tried = np.empty(count)
    for _ in range(most):
        step = _step(hessian, gradient, free, lower, upper, values, damping, _FLOOR * total)
        longest = 0.0
        for c in range(count):
            tried[c] = min(max(values[c] + step[c], lower[c]), upper[c]) if free[c] else values[c]
            longest = max(longest, abs(tried[c] - values[c]) if free[c] else 0.0)
        new_cost, _ = evaluate(packed, markers, tasks, tried, variable, slope, state, nothing, gradient)
        if new_cost <= cost:
            copy_row(values, tried)
            damping = max(0.1 * damping, 1e-12)
            if longest < stop:
                return new_cost, True
            cost, total = evaluate(packed, markers, tasks, values, variable, slope, state, hessian, gradient)
        elif longest < stop:
            return cost, True
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return cost, False


@kernel
def _step(hessian, gradient, free, lower, upper, values, damping, floor):
    """Solve for a damped step (N,) of the free coordinates."""
    count = values.shape[0]
    index = np.empty(count, np.int64)
    n = 0
    for c in range(count):
        held = (values[c] <= lower[c] and gradient[c] > 0.0) or (values[c] >= upper[c] and gradient[c] < 0.0)
        if free[c] and not held:
            index[n] = c
            n += 1
    factor, answer = np.empty((n, n)), np.empty(n)
    for i in range(n):
        t = -gradient[index[i]]
        for j in range(i + 1):
            s = hessian[index[i], index[j]]
            if i == j:
                s += damping * s + floor
            for k in range(j):
                s -= factor[i, k] * factor[j, k]
            if i == j:
                factor[i, i] = np.sqrt(max(s, floor))
            else:
                factor[i, j] = s / factor[j, j]
        for k in range(i):
            t -= factor[i, k] * answer[k]
        answer[i] = t / factor[i, i]
    step = np.zeros(count)
    longest = 0.0
    for i in range(n - 1, -1, -1):
        t = answer[i]
        for k in range(i + 1, n):
            t -= factor[k, i] * answer[k]
        answer[i] = t / factor[i, i]
        step[index[i]] = answer[i]
        longest = max(longest, abs(answer[i]))
    if longest > _LONGEST:
        step *= _LONGEST / longest
    return step
