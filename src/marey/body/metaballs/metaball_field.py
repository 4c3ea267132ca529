"""Kernels of the metaballs' field: its logarithm, the distance to the surface, and their derivatives."""

import numpy as np

from marey.compiled.kernel_copies import copy_matrix
from marey.compiled.kernels import kernel

THRESHOLD = 0.5
"""Value of the field on the surface ([Plaenkers1999] section 3.4.3)."""
LEAST_SLOPE = 2.0
"""Least slope by which the logarithm of the field is divided for a distance [1/m]; 0.15 m from the axis of the
thickest limb it is above 9."""
CORE = 500.0
"""Assumed curvature of the logarithm of the field inside the surface [1/m2]: that of a limb 0.075 m thick."""
_FAR = -40.0
"""Exponent below which a term is negligible beside 1: exp(-40) is 4e-18."""
_NEGLIGIBLE = float(np.exp(_FAR))
"""Share of the field below which a ball is ignored."""


@kernel(inline="always")
def log_field(m, point, place, axes, radii, log_weight, local):
    """Return ln w - 2 d of one ball at a point ([Plaenkers1999] eq. (6), (7)); write its coordinates along the axes."""
    d = 0.0
    for a in range(3):
        y = 0.0
        for b in range(3):
            y += axes[m, a, b] * (point[b] - place[m, b])
        local[m, a] = y
        d += (y / radii[m, a]) ** 2
    return log_weight - 2.0 * d


@kernel
def logarithms(values):
    """Return the logarithms (n,) of numbers (n,)."""
    out = np.empty(values.shape[0])
    for i in range(values.shape[0]):
        out[i] = np.log(values[i])
    return out


@kernel
def _weigh(point, limb, ball_limb, place, axes, radii, log_weight, local, share, top, total):
    """Compute where a point lies in each ball, and each ball's share of the field.

    Args:
        point: (3,).
        limb: Limb of the point; below 1 the one whose field is greatest.
        ball_limb: (M,).
        place: (M, 3).
        axes: (M, 3, 3).
        radii: (M, 3).
        log_weight: (M,) logarithms of the balls' weights.
        local: (M, 3) output: coordinates along the ball's axes.
        share: (M,) output.
        top: (L,) scratch, by limb.
        total: (L,) scratch.

    Returns:
        ln(F / T).
    """
    top[:] = -np.inf
    total[:] = 0.0
    for m in range(radii.shape[0]):
        share[m] = -np.inf
        if limb < 1 or ball_limb[m] == limb or ball_limb[m] == 0:
            share[m] = log_field(m, point, place, axes, radii, log_weight[m], local)
            top[ball_limb[m]] = max(top[ball_limb[m]], share[m])
    for m in range(radii.shape[0]):
        below = share[m] - top[ball_limb[m]]
        share[m] = np.exp(below) if below > _FAR else 0.0
        total[ball_limb[m]] += share[m]
    for k in range(top.shape[0]):
        top[k] += np.log(total[k]) if total[k] > 0.0 else 0.0
    if limb < 1:
        limb = 1 + np.argmax(top[1:])
    high, low = max(top[0], top[limb]), min(top[0], top[limb])
    level = high + np.log1p(np.exp(max(low - high, _FAR)))
    # From here on, `total` is the factor from a ball's part of its limb's field to its part of the whole field.
    for k in range(top.shape[0]):
        contributes = (k == 0 or k == limb) and top[k] - level > _FAR
        total[k] = np.exp(top[k] - level) / total[k] if contributes else 0.0
    for m in range(radii.shape[0]):
        own = share[m] * total[ball_limb[m]]
        share[m] = own if own > _NEGLIGIBLE else 0.0
    return level - np.log(THRESHOLD)


@kernel
def levels(points, limbs, limb_count, ball_limb, place, axes, radii, weight):
    """Return ln(F / T) (n,) at points (n, 3), see `_weigh`."""
    log_weight = logarithms(weight)
    local, share = np.empty((radii.shape[0], 3)), np.empty(radii.shape[0])
    top, total = np.empty(limb_count), np.empty(limb_count)
    level = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        level[i] = _weigh(points[i], limbs[i], ball_limb, place, axes, radii, log_weight, local, share, top, total)
    return level


@kernel
def shares(points, limbs, limb_count, ball_limb, place, axes, radii, weight):
    """Return each ball's share of the field (n, M) at points (n, 3), see `_weigh`."""
    log_weight = logarithms(weight)
    local, top, total = np.empty((radii.shape[0], 3)), np.empty(limb_count), np.empty(limb_count)
    share = np.empty((points.shape[0], radii.shape[0]))
    for i in range(points.shape[0]):
        _weigh(points[i], limbs[i], ball_limb, place, axes, radii, log_weight, local, share[i], top, total)
    return share


@kernel
def _slope(axes, radii, local, share, gradient):
    """Write the gradient (3,) of ln F at the point of `local` and `share`."""
    gradient[:] = 0.0
    for m in range(radii.shape[0]):
        if share[m] > 0.0:
            for a in range(3):
                along = -4.0 * share[m] * local[m, a] / radii[m, a] ** 2
                for b in range(3):
                    gradient[b] += along * axes[m, a, b]


@kernel
def distance_of_level(level, square):
    """Return the distance from L = ln(F / T) and |grad L|^2, with its derivatives by L and by grad L . d(grad L).

    With g = sqrt(|grad L|^2 + k^2) it is -L / g outside, and inside -L / ((g + q) / 2), q = sqrt(g^2 + 4 c L).
    """
    g = np.sqrt(square + LEAST_SLOPE**2)
    if level <= 0.0:
        return -level / g, -1.0 / g, level / g**3
    q = np.sqrt(g * g + 4.0 * CORE * level)
    mean = 0.5 * (g + q)
    return -level / mean, -1.0 / mean + level * CORE / (q * mean * mean), 0.5 * level * (1.0 / g + 1.0 / q) / mean**2


@kernel
def distances(points, limbs, limb_count, ball_limb, place, axes, radii, weight):
    """Return the distances (n,) of points (n, 3) outside the surface, see `distance_of_level`."""
    log_weight = logarithms(weight)
    local, share = np.empty((radii.shape[0], 3)), np.empty(radii.shape[0])
    top, total, slope = np.empty(limb_count), np.empty(limb_count), np.empty(3)
    distance = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        level = _weigh(points[i], limbs[i], ball_limb, place, axes, radii, log_weight, local, share, top, total)
        _slope(axes, radii, local, share, slope)
        square = slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2
        distance[i] = distance_of_level(level, square)[0]
    return distance


@kernel
def bring_onto(
    points, limbs, limb_count, ball_limb, place, axes, radii, weight, steps, longest, close
):  # fmt: skip
    """Move points (n, 3) along the surface's normals until they are close to it, by steps of limited length."""
    log_weight = logarithms(weight)
    local, share = np.empty((radii.shape[0], 3)), np.empty(radii.shape[0])
    top, total, slope = np.empty(limb_count), np.empty(limb_count), np.empty(3)
    for i in range(points.shape[0]):
        for _ in range(steps):
            level = _weigh(points[i], limbs[i], ball_limb, place, axes, radii, log_weight, local, share, top, total)
            _slope(axes, radii, local, share, slope)
            square = slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2
            off = min(max(distance_of_level(level, square)[0], -longest), longest)
            for a in range(3):
                points[i, a] += off * slope[a] / np.sqrt(max(square, 1e-12))
            if abs(off) < close:
                break


@kernel
def step_onto(points, limbs, limb_count, ball_limb, place, axes, radii, weight, longest):
    """Move points (n, 3) against the gradient of their distance by that distance, or less; return the longest step."""
    log_weight = logarithms(weight)
    local, share = np.empty((radii.shape[0], 3)), np.empty(radii.shape[0])
    top, total, slope = np.empty(limb_count), np.empty(limb_count), np.empty(3)
    by_point, farthest = np.empty(3), 0.0
    for i in range(points.shape[0]):
        level = _weigh(points[i], limbs[i], ball_limb, place, axes, radii, log_weight, local, share, top, total)
        _slope(axes, radii, local, share, slope)
        square = slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2
        away, first, second = distance_of_level(level, square)
        by_point[:] = 0.0
        for m in range(radii.shape[0]):
            if share[m] > 0.0:
                _add_gradient(share[m], first, second, slope, square, local[m], axes[m], radii[m], by_point)
        steep = np.sqrt(by_point[0] ** 2 + by_point[1] ** 2 + by_point[2] ** 2)
        off = min(max(away / steep, -longest), longest)
        for a in range(3):
            points[i, a] -= off / steep * by_point[a]
        farthest = max(farthest, abs(off))
    return farthest


@kernel
def _add_gradient(share, first, second, slope, square, y, axes, radii, by_point):
    """Add one ball's part in the gradient of the distance, as `_linearize_ball` does."""
    s0, s1, s2 = slope[0], slope[1], slope[2]
    steep = 0.0
    for a in range(3):
        steep -= 4.0 * y[a] / radii[a] ** 2 * (axes[a, 0] * s0 + axes[a, 1] * s1 + axes[a, 2] * s2)
    u, v = share * (first + second * (steep - square)), share * second
    for a in range(3):
        g = axes[a, 0] * s0 + axes[a, 1] * s1 + axes[a, 2] * s2
        along = -4.0 / radii[a] ** 2 * (u * y[a] + v * g)
        for b in range(3):
            by_point[b] += along * axes[a, b]


@kernel
def nearest_limbs(points, limb_count, ball_limb, place, axes, radii, weight):
    """Return for points (n, 3) the limb (n,) whose own field is greatest there, and the outward unit normal (n, 3)."""
    log_weight = logarithms(weight)
    local, share = np.empty((radii.shape[0], 3)), np.empty(radii.shape[0])
    top, total, slope = np.empty(limb_count), np.empty(limb_count), np.empty(3)
    limb, outward = np.empty(points.shape[0], np.int64), np.zeros((points.shape[0], 3))
    for i in range(points.shape[0]):
        _weigh(points[i], -1, ball_limb, place, axes, radii, log_weight, local, share, top, total)
        limb[i] = np.argmax(top)
        _slope(axes, radii, local, share, slope)
        steep = np.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2)
        for a in range(3):
            outward[i, a] = -slope[a] / max(steep, 1e-9)
    return limb, outward


@kernel
def linearize(
    points, limbs, limb_count, ball_limb, place, axes, radii, weight, segment, rotation, as_distance,
    residual, by_point, by_centre, by_radii, by_weight, by_shift, by_turn,
):  # fmt: skip
    """Write the residual and its derivatives, see `metaballs.Linearized`; all outputs are initialised with zeros.

    With L = ln(F / T), G its gradient and p_m the share of ball m, whose logarithm of the field is f_m, any change t of
    ball m gives dL = p_m f_mt and G.dG = p_m (G.grad f_mt + f_mt (G.grad f_m - |G|^2)), by which the distance changes
    according to `distance_of_level`.
    """
    log_weight = logarithms(weight)
    local, share = np.empty((radii.shape[0], 3)), np.empty(radii.shape[0])
    top, total, slope = np.empty(limb_count), np.empty(limb_count), np.empty(3)
    for i in range(points.shape[0]):
        level = _weigh(points[i], limbs[i], ball_limb, place, axes, radii, log_weight, local, share, top, total)
        _slope(axes, radii, local, share, slope)
        square = slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2
        if as_distance:
            residual[i], first, second = distance_of_level(level, square)
        else:
            residual[i] = THRESHOLD * np.expm1(level)
            first, second = THRESHOLD * np.exp(level), 0.0
        for m in range(radii.shape[0]):
            if share[m] > 0.0:
                _linearize_ball(
                    m, segment[m], share[m], first, second, slope, square, local[m], axes[m], radii[m], weight[m],
                    rotation[m], by_point[i], by_centre[i], by_radii[i], by_weight[i], by_shift[i], by_turn[i],
                )  # fmt: skip


@kernel
def _linearize_ball(
    m, k, share, first, second, slope, square, y, axes, radii, weight, rotation,
    by_point, by_centre, by_radii, by_weight, by_shift, by_turn,
):  # fmt: skip
    """Write one ball's part in one point's derivatives; first and second weigh dL and G.dG, see `linearize`."""
    s0, s1, s2 = slope[0], slope[1], slope[2]
    own0 = own1 = own2 = 0.0
    for a in range(3):
        rise = -4.0 * y[a] / radii[a] ** 2
        own0 += rise * axes[a, 0]
        own1 += rise * axes[a, 1]
        own2 += rise * axes[a, 2]
    steep = own0 * s0 + own1 * s1 + own2 * s2
    u = share * (first + second * (steep - square))
    v = share * second
    by_weight[m] = u / weight
    for a in range(3):
        g = axes[a, 0] * s0 + axes[a, 1] * s1 + axes[a, 2] * s2
        curve = 4.0 / radii[a] ** 2
        by_radii[m, a] = (u * y[a] + 2.0 * v * g) * y[a] * curve / radii[a]
        along = -curve * (u * y[a] + v * g)
        for b in range(3):
            by_point[b] += along * axes[a, b]
            by_shift[k, b] -= along * axes[a, b]
            by_centre[m, b] -= along * rotation[b, a]
    by_turn[k, 0] += v * (own1 * s2 - own2 * s1)
    by_turn[k, 1] += v * (own2 * s0 - own0 * s2)
    by_turn[k, 2] += v * (own0 * s1 - own1 * s0)


@kernel
def by_pose(parents, coordinate_segment, origin, world_axes, points, by_shift, by_turn, jacobian):
    """Write the derivatives (n, D) of residuals of points (n, 3) by the pose, the root's translation and turn first.

    A joint moves all segments beyond it: their shifts and rotations are summed from the ends of the tree to its root,
    and a rotation about the joint at o is one about the point p and a shift by the axis x (p - o).
    """
    segments = parents.shape[0]
    shift, turn = np.empty((segments, 3)), np.empty((segments, 3))
    for i in range(points.shape[0]):
        copy_matrix(shift, by_shift[i])
        copy_matrix(turn, by_turn[i])
        for k in range(segments - 1, -1, -1):
            x, y, z = points[i, 0] - origin[k, 0], points[i, 1] - origin[k, 1], points[i, 2] - origin[k, 2]
            if parents[k] >= 0:
                for a in range(3):
                    shift[parents[k], a] += shift[k, a]
                    turn[parents[k], a] += turn[k, a]
            turn[k, 0] += y * shift[k, 2] - z * shift[k, 1]
            turn[k, 1] += z * shift[k, 0] - x * shift[k, 2]
            turn[k, 2] += x * shift[k, 1] - y * shift[k, 0]
        for a in range(3):
            jacobian[i, a] = shift[0, a]
            jacobian[i, 3 + a] = turn[0, a]
        for q in range(world_axes.shape[0]):
            k = coordinate_segment[q]
            jacobian[i, 6 + q] = (
                world_axes[q, 0] * turn[k, 0] + world_axes[q, 1] * turn[k, 1] + world_axes[q, 2] * turn[k, 2]
            )
