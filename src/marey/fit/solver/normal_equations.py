"""Normal equations of a pose from the moments of its surface observations."""

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody
from marey.compiled.kernel_copies import copy_row
from marey.compiled.kernels import kernel
from marey.fit.solver.moments import Moments
from marey.lanes import LANES, put_combination

_ENTRY = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Index of the entry (a, b) of a symmetric matrix among its six stored values."""


def normal_equations(posed: PosedBody, moments: Moments) -> tuple[Floats, Floats, float]:
    """Assemble H = J'WJ (D, D), g = J'Wr (D,) and the cost r'Wr in a pose."""
    packed = posed.body.packed
    degrees = 6 + len(packed.axes)
    hessian = np.zeros((degrees, degrees))
    gradient = np.zeros(degrees)
    cost = assemble(
        packed.parents, packed.coordinate_segment, posed.segment_rotation, posed.segment_origin, posed.world_axes,
        moments.pairs, moments.products, moments.linear, hessian, gradient,
    )  # fmt: skip
    return hessian, gradient, cost + moments.constant


@kernel
def coordinate_twists(coordinate_segment, origin, world_axes):
    """Return the first segment that each coordinate moves, and the coordinate's twist (v, w) about the world's origin.

    Returns:
        start (D,), twist (D, 6).
    """
    degrees = 6 + world_axes.shape[0]
    start = np.zeros(degrees, np.int64)
    twist = np.zeros((degrees, 6))
    for a in range(3):
        twist[a, a] = 1.0
        twist[3 + a, 3 + a] = 1.0
    for i in range(world_axes.shape[0]):
        start[6 + i] = coordinate_segment[i]
        copy_row(twist[6 + i, 3:], world_axes[i])
    for q in range(3, degrees):
        # v = origin x w
        o, w = origin[start[q]], twist[q, 3:]
        twist[q, 0] = o[1] * w[2] - o[2] * w[1]
        twist[q, 1] = o[2] * w[0] - o[0] * w[2]
        twist[q, 2] = o[0] * w[1] - o[1] * w[0]
    return start, twist


@kernel(fastmath=True)
def assemble(
    parents, coordinate_segment, rotation, origin, world_axes, pairs, products, linear, hessian, gradient
):  # fmt: skip
    """Add the normal equations of all pairs of segments; return the cost without its constant.

    A coordinate moves its segment and all segments beyond it: the terms of pairs of segments are therefore first summed
    from the ends of the limbs towards the root, after which each pair of coordinates needs one product.
    """
    segments = parents.shape[0]
    size = 6 * LANES
    row, both = segments * size, (1.0, 1.0)
    blocks = np.zeros(segments * row)
    force = np.zeros((segments, 6))
    cost = _pair_sums(rotation, origin, pairs, products.ravel(), blocks, force)
    for k in range(segments):
        cost += _subtract_target(rotation[k], origin[k], linear[k], force[k])
    for k in range(segments - 1, 0, -1):
        for a in range(6):
            force[parents[k], a] += force[k, a]
        for e in range(0, row, LANES):
            put_combination(blocks, parents[k] * row + e, both, blocks, k * row + e, (parents[k] - k) * row)
    for j in range(segments - 1, 0, -1):
        for k in range(segments):
            for e in range(k * row, k * row + size, LANES):
                put_combination(blocks, e + parents[j] * size, both, blocks, e + j * size, (parents[j] - j) * size)
    start, twist = coordinate_twists(coordinate_segment, origin, world_axes)
    moved = np.empty(segments * LANES)
    for q in range(start.shape[0]):
        for a in range(6):
            gradient[q] += twist[q, a] * force[start[q], a]
        way = (twist[q, 0], twist[q, 1], twist[q, 2], twist[q, 3], twist[q, 4], twist[q, 5])
        for k in range(start[q] + 1):
            put_combination(moved, k * LANES, way, blocks, start[q] * row + k * size, LANES)
        for p in range(q + 1):
            at = start[p] * LANES
            t = twist[p, 0] * moved[at] + twist[p, 1] * moved[at + 1] + twist[p, 2] * moved[at + 2]
            t += twist[p, 3] * moved[at + 3] + twist[p, 4] * moved[at + 4] + twist[p, 5] * moved[at + 5]
            hessian[q, p] += t
            if p < q:
                hessian[p, q] += t
    return cost


@kernel(fastmath=True)
def _pair_sums(rotation, origin, pairs, products, blocks, force):
    """Write each pair's block of twists and add the points' forces; return the quadratic part of the cost.

    The blocks are flat (S, S, 6, 8): the entry (a, b) of the pair (k, j) is at [k, j, a, b].
    """
    half = np.empty(16 * LANES)
    z = np.empty((4, 4, LANES))
    flat = z.ravel()
    segments = rotation.shape[0]
    cost = 0.0
    for p in range(pairs.shape[0]):
        k, j = pairs[p, 0], pairs[p, 1]
        first = p * 16 * LANES
        for r in range(3):
            motion = (rotation[k, r, 0], rotation[k, r, 1], rotation[k, r, 2], origin[k, r])
            for c in range(4):
                put_combination(half, (4 * r + c) * LANES, motion, products, first + c * LANES, 4 * LANES)
        for e in range(12 * LANES, 16 * LANES):
            half[e] = products[first + e]
        for c in range(3):
            motion = (rotation[j, c, 0], rotation[j, c, 1], rotation[j, c, 2], origin[j, c])
            for r in range(4):
                put_combination(flat, (4 * r + c) * LANES, motion, half, 4 * r * LANES, LANES)
        for r in range(4):
            for e in range(LANES):
                z[r, 3, e] = half[(4 * r + 3) * LANES + e]
        square = z[0, 0, 0] + z[1, 1, 3] + z[2, 2, 5]
        for a in range(3):
            for b in range(a + 1, 3):
                square += z[a, b, _ENTRY[a, b]] + z[b, a, _ENTRY[a, b]]
        cost += square if k == j else 2.0 * square
        _pair_block(z, blocks, (k * segments + j) * 6 * LANES, 1, LANES)
        if k != j:
            _pair_block(z, blocks, (j * segments + k) * 6 * LANES, LANES, 1)
        _add_forces(z, k, j, force)
    return cost


@kernel(inline="always", fastmath=True)
def _pair_block(z, blocks, at, column, row):
    """Write the 6x6 block of two segments' twists from z[r, c, ab] = sum w Q_ab y_k[r] y_l[c]."""
    for a in range(3):
        for b in range(3):
            blocks[at + row * a + column * b] = z[3, 3, _ENTRY[a, b]]
    for c in range(3):
        c1, c2 = (c + 1) % 3, (c + 2) % 3
        for a in range(3):
            # w x y, component b: -[y]x; for the axis c only b = c1 and c2 move.
            first = z[3, c1, _ENTRY[a, c2]] - z[3, c2, _ENTRY[a, c1]]
            blocks[at + row * a + column * (3 + c)] = first
            second = z[c1, 3, _ENTRY[c2, a]] - z[c2, 3, _ENTRY[c1, a]]
            blocks[at + row * (3 + c) + column * a] = second
    for c in range(3):
        c1, c2 = (c + 1) % 3, (c + 2) % 3
        for d in range(3):
            d1, d2 = (d + 1) % 3, (d + 2) % 3
            turn = z[c1, d1, _ENTRY[c2, d2]] - z[c1, d2, _ENTRY[c2, d1]]
            turn += z[c2, d2, _ENTRY[c1, d1]] - z[c2, d1, _ENTRY[c1, d2]]
            blocks[at + row * (3 + c) + column * (3 + d)] = turn


@kernel(fastmath=True)
def _add_forces(z, k, j, force):
    """Add the forces of the pair's points on each of its two segments."""
    for c in range(3):
        c1, c2 = (c + 1) % 3, (c + 2) % 3
        for b in range(3):
            force[k, c] += z[3, b, _ENTRY[c, b]]
            force[k, 3 + c] += z[c1, b, _ENTRY[c2, b]] - z[c2, b, _ENTRY[c1, b]]
            if k != j:
                force[j, c] += z[b, 3, _ENTRY[b, c]]
                force[j, 3 + c] += z[b, c1, _ENTRY[b, c2]] - z[b, c2, _ENTRY[b, c1]]


@kernel(fastmath=True)
def _subtract_target(rotation, origin, linear, force):
    """Subtract the force of the targets from a segment's force; return the linear part of the cost."""
    y = np.empty((3, 4))
    cost = 0.0
    for a in range(3):
        for r in range(3):
            t = linear[3, a] * origin[r]
            for s in range(3):
                t += linear[s, a] * rotation[r, s]
            y[a, r] = t
        y[a, 3] = linear[3, a]
        cost -= 2.0 * y[a, a]
    for c in range(3):
        c1, c2 = (c + 1) % 3, (c + 2) % 3
        force[c] -= y[c, 3]
        force[3 + c] -= y[c2, c1] - y[c1, c2]
    return cost
