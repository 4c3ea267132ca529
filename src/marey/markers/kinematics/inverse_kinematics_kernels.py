"""Kernels of inverse kinematics: one posture by weighted least squares over all markers."""

import numpy as np

from marey.body.articulation.jointed_kinematics import follow, place_bodies
from marey.kernels import kernel

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
        p = _posed(rotation, origin, body[m], place[m])
        r = (p[0] - observed[m, 0], p[1] - observed[m, 1], p[2] - observed[m, 2])
        cost += w * (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        if derive:
            number = marker_rows(packed, body[m], p, axes, points, motion_slope, variable, slope, rows, used)
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


@kernel(inline="always")
def _posed(rotation, origin, body, place):
    if body < 0:
        return place[0], place[1], place[2]
    r, o = rotation[body], origin[body]
    return (
        o[0] + r[0, 0] * place[0] + r[0, 1] * place[1] + r[0, 2] * place[2],
        o[1] + r[1, 0] * place[0] + r[1, 1] * place[1] + r[1, 2] * place[2],
        o[2] + r[2, 0] * place[0] + r[2, 1] * place[1] + r[2, 2] * place[2],
    )


@kernel
def marker_rows(packed, body, p, axes, points, motion_slope, variable, slope, rows, used):
    """Write a point's derivatives by the coordinates into rows (N, 3), list them in used, and return their number."""
    number = 0
    k = body
    while k >= 0:
        for e in range(packed.first[k], packed.first[k + 1]):
            c = packed.coordinate[e]
            if c < 0:
                continue
            a = variable[c]
            s = motion_slope[e] * slope[c]
            known = False
            for i in range(number):
                known = known or used[i] == a
            if not known:
                used[number] = a
                number += 1
                rows[a, 0] = rows[a, 1] = rows[a, 2] = 0.0
            u, q = axes[e], points[e]
            if packed.turns[e]:
                d0, d1, d2 = p[0] - q[0], p[1] - q[1], p[2] - q[2]
                rows[a, 0] += s * (u[1] * d2 - u[2] * d1)
                rows[a, 1] += s * (u[2] * d0 - u[0] * d2)
                rows[a, 2] += s * (u[0] * d1 - u[1] * d0)
            else:
                rows[a, 0] += s * u[0]
                rows[a, 1] += s * u[1]
                rows[a, 2] += s * u[2]
        k = packed.parents[k]
    return number


@kernel
def new_state(packed):
    """Allocate the arrays that `place_bodies` fills."""
    bodies, motions = packed.parents.shape[0], packed.turns.shape[0]
    return (
        np.empty((bodies, 3, 3)), np.empty((bodies, 3)), np.empty((motions, 3)), np.empty((motions, 3)),
        np.empty(motions),
    )  # fmt: skip


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
            values[:] = tried
            damping = max(0.1 * damping, 1e-12)
            if longest < stop:
                return new_cost, True
            cost, total = evaluate(packed, markers, tasks, values, variable, slope, state, hessian, gradient)
        elif longest < stop:
            follow(packed, values, variable, slope)
            return cost, True
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    follow(packed, values, variable, slope)
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


@kernel
def linearised(packed, body, place, values):
    """Linearise the markers and bodies of a posture for the covariance.

    Returns:
        Points (M, 3) and jacobian (M, 3, N) of the markers; rotation (B, 3, 3) and origin (B, 3) of the bodies and
        their derivatives (B, 6, N): the rotation about the body's own axes, then the origin in the ground.
    """
    count = values.shape[0]
    state = new_state(packed)
    rotation, origin, axes, points, motion_slope = state
    variable, slope = np.empty(count, np.int64), np.empty(count)
    follow(packed, values, variable, slope)
    place_bodies(packed, values, rotation, origin, axes, points, motion_slope)
    rows, used = np.empty((count, 3)), np.empty(count, np.int64)
    posed = np.empty((body.shape[0], 3))
    jacobian = np.zeros((body.shape[0], 3, count))
    for m in range(body.shape[0]):
        p = _posed(rotation, origin, body[m], place[m])
        number = marker_rows(packed, body[m], p, axes, points, motion_slope, variable, slope, rows, used)
        for a in range(3):
            posed[m, a] = p[a]
            for i in range(number):
                jacobian[m, a, used[i]] = rows[used[i], a]
    moved = np.zeros((rotation.shape[0], 6, count))
    for k in range(rotation.shape[0]):
        o = (origin[k, 0], origin[k, 1], origin[k, 2])
        number = marker_rows(packed, k, o, axes, points, motion_slope, variable, slope, rows, used)
        for i in range(number):
            for a in range(3):
                moved[k, 3 + a, used[i]] = rows[used[i], a]
        j = k
        while j >= 0:
            for e in range(packed.first[j], packed.first[j + 1]):
                c = packed.coordinate[e]
                if c >= 0 and packed.turns[e]:
                    s = motion_slope[e] * slope[c]
                    for a in range(3):
                        turn = rotation[k, 0, a] * axes[e, 0] + rotation[k, 1, a] * axes[e, 1]
                        moved[k, a, variable[c]] += s * (turn + rotation[k, 2, a] * axes[e, 2])
            j = packed.parents[j]
    return posed, jacobian, rotation, origin, moved
