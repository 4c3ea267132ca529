"""The pose's normal equations from moments: built once, after which a step costs the same for any number of points.

A surface point p is the sum over its segments k of T_k y_k. For residuals A p - b the cost is a quadratic
in the segments' motions T for as long as the correspondences are fixed: all of it lies in the moments
W = sum w (A'A) x (y_k y_l') and U = sum w (A'b) y_k'. Ours: pairs of segments, so that blended skin is exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from marey.arrays import Floats, Integers
from marey.body.kinematics import split_point
from marey.body.pose import PARTS, PosedBody
from marey.observations.observation import SurfaceObservation

_AB = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class Moments:
    """What the normal equations need to know of all surface observations."""

    pairs: Integers
    """(m, 2) pairs of segments k <= l that share an observation."""
    products: Floats
    """(m, 6, 4, 4) of the pairs; the six entries of the symmetric A'A in the order 00 01 02 11 12 22."""
    linear: Floats
    """(S, 3, 4) of the segments."""
    constant: float
    """Sum of w b'b."""


def gather_moments(
    posed: PosedBody, observations: Sequence[SurfaceObservation], weights: Sequence[Floats] | None = None
) -> Moments:
    """Gather the moments of surface observations.

    Args:
        posed: the body; only its rest shape and the constraints' scales matter, not its pose.
        observations: any kinds.
        weights: for each observation (n,) robust weights of its points; all one when missing.
    """
    body = posed.body
    segments = len(body.skeleton.segment_names)
    slot = np.full((segments, segments), -1, np.int64)
    products = np.zeros((segments * (segments + 1) // 2, 6, 16))
    linear = np.zeros((segments, 3, 4))
    constant = used = 0
    for i, observation in enumerate(observations):
        rows, offsets = observation.constraints(posed)
        weight = np.ones(len(rows)) if weights is None else weights[i]
        used, more = add_moments(
            body.faces, body.vertices, body.vertex_segments, body.vertex_weights, body.joint_centres,
            observation.where.face, observation.where.barycentric, np.ascontiguousarray(rows),
            np.ascontiguousarray(offsets), weight / observation.sigma**2, slot, used, products, linear,
        )  # fmt: skip
        constant += more
    pairs = np.zeros((used, 2), np.int64)
    k, j = np.nonzero(slot >= 0)
    pairs[slot[k, j]] = np.stack([k, j], 1)
    blocks = products[:used].reshape(-1, 6, 4, 4)
    own = pairs[:, 0] == pairs[:, 1]
    blocks[own] += np.swapaxes(np.triu(blocks[own], 1), 2, 3)
    return Moments(pairs, blocks, linear, float(constant))


@numba.njit(cache=True, nogil=True, fastmath=True)
def add_moments(
    faces, vertices, vertex_segments, vertex_weights, joints, face, barycentric, rows, offsets, weight,
    slot, used, products, linear,
):  # fmt: skip
    """Add observations to the moments; give the number of pairs in use and the sum of w b'b."""
    constant = 0.0
    q = np.empty(6)
    segment = np.empty((1, PARTS), np.int64)
    part = np.empty((1, PARTS, 4))
    for i in range(rows.shape[0]):
        w = weight[i]
        if w <= 0.0:
            continue
        q0 = q1 = q2 = q3 = q4 = q5 = u0 = u1 = u2 = 0.0
        for r in range(rows.shape[1]):
            x, y, z, b = rows[i, r, 0], rows[i, r, 1], rows[i, r, 2], offsets[i, r]
            wx, wy, wz = w * x, w * y, w * z
            q0 += wx * x
            q1 += wx * y
            q2 += wx * z
            q3 += wy * y
            q4 += wy * z
            q5 += wz * z
            u0 += wx * b
            u1 += wy * b
            u2 += wz * b
            constant += w * b * b
        q[0], q[1], q[2], q[3], q[4], q[5] = q0, q1, q2, q3, q4, q5
        split_point(
            faces, PARTS, vertices, vertex_segments, vertex_weights, joints, face[i], barycentric, i, segment, part, 0
        )
        for n in range(PARTS):
            k = segment[0, n]
            if k < 0:
                break
            for c in range(4):
                y = part[0, n, c]
                linear[k, 0, c] += u0 * y
                linear[k, 1, c] += u1 * y
                linear[k, 2, c] += u2 * y
            for m in range(PARTS):
                j = segment[0, m]
                if j < 0:
                    break
                if j < k:
                    continue
                if slot[k, j] < 0:
                    slot[k, j] = used
                    used += 1
                if m == n:
                    _add_square(q, part, n, products[slot[k, k]])
                else:
                    _add_product(q, part, n, m, products[slot[k, j]])
    return used, constant


@numba.njit(inline="always", cache=True, nogil=True, fastmath=True)
def _add_product(q, part, n, m, product):
    """Add q[ab] y_n y_m' to a pair's products (6, 16); written out so that the compiler makes vectors of it."""
    a0, a1, a2, a3 = part[0, n, 0], part[0, n, 1], part[0, n, 2], part[0, n, 3]
    b0, b1, b2, b3 = part[0, m, 0], part[0, m, 1], part[0, m, 2], part[0, m, 3]
    y0, y1, y2, y3 = a0 * b0, a0 * b1, a0 * b2, a0 * b3
    y4, y5, y6, y7 = a1 * b0, a1 * b1, a1 * b2, a1 * b3
    y8, y9, y10, y11 = a2 * b0, a2 * b1, a2 * b2, a2 * b3
    y12, y13, y14, y15 = a3 * b0, a3 * b1, a3 * b2, a3 * b3
    for ab in range(6):
        t = q[ab]
        product[ab, 0] += t * y0
        product[ab, 1] += t * y1
        product[ab, 2] += t * y2
        product[ab, 3] += t * y3
        product[ab, 4] += t * y4
        product[ab, 5] += t * y5
        product[ab, 6] += t * y6
        product[ab, 7] += t * y7
        product[ab, 8] += t * y8
        product[ab, 9] += t * y9
        product[ab, 10] += t * y10
        product[ab, 11] += t * y11
        product[ab, 12] += t * y12
        product[ab, 13] += t * y13
        product[ab, 14] += t * y14
        product[ab, 15] += t * y15


@numba.njit(inline="always", cache=True, nogil=True, fastmath=True)
def _add_square(q, part, n, product):
    """Add q[ab] y_n y_n' to a segment's own products (6, 16): the upper triangle only, the rest is its image."""
    a0, a1, a2, a3 = part[0, n, 0], part[0, n, 1], part[0, n, 2], part[0, n, 3]
    y0, y1, y2, y3 = a0 * a0, a0 * a1, a0 * a2, a0 * a3
    y5, y6, y7 = a1 * a1, a1 * a2, a1 * a3
    y10, y11 = a2 * a2, a2 * a3
    y15 = a3 * a3
    for ab in range(6):
        t = q[ab]
        product[ab, 0] += t * y0
        product[ab, 1] += t * y1
        product[ab, 2] += t * y2
        product[ab, 3] += t * y3
        product[ab, 5] += t * y5
        product[ab, 6] += t * y6
        product[ab, 7] += t * y7
        product[ab, 10] += t * y10
        product[ab, 11] += t * y11
        product[ab, 15] += t * y15


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


@numba.njit(cache=True, nogil=True)
def coordinate_twists(coordinate_segment, origin, world_axes):
    """Give for each coordinate the segment with which its motion begins, and its twist (v, w) about the world's origin.

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
        twist[6 + i, 3:] = world_axes[i]
    for q in range(3, degrees):
        # v = origin x w
        o, w = origin[start[q]], twist[q, 3:]
        twist[q, 0] = o[1] * w[2] - o[2] * w[1]
        twist[q, 1] = o[2] * w[0] - o[0] * w[2]
        twist[q, 2] = o[0] * w[1] - o[1] * w[0]
    return start, twist


@numba.njit(cache=True, nogil=True, fastmath=True)
def assemble(
    parents, coordinate_segment, rotation, origin, world_axes, pairs, products, linear, hessian, gradient
):  # fmt: skip
    """Add the normal equations of all pairs of segments; give the cost without its constant.

    A coordinate moves its segment and all that hang on it: what pairs of segments say is first summed
    from the far ends of the limbs towards the root, and each pair of coordinates then needs one product.
    """
    segments = parents.shape[0]
    block = np.zeros((segments, segments, 36))
    force = np.zeros((segments, 6))
    cost = _pair_sums(rotation, origin, pairs, products, block, force)
    for k in range(segments):
        cost += _subtract_target(rotation[k], origin[k], linear[k], force[k])
    size = block.shape[2]
    for k in range(segments - 1, 0, -1):
        for a in range(6):
            force[parents[k], a] += force[k, a]
        for j in range(segments):
            for e in range(size):
                block[parents[k], j, e] += block[k, j, e]
    for j in range(segments - 1, 0, -1):
        for k in range(segments):
            for e in range(size):
                block[k, parents[j], e] += block[k, j, e]
    start, twist = coordinate_twists(coordinate_segment, origin, world_axes)
    moved = np.empty((segments, 6))
    for q in range(start.shape[0]):
        for a in range(6):
            gradient[q] += twist[q, a] * force[start[q], a]
        w0, w1, w2, w3, w4, w5 = twist[q, 0], twist[q, 1], twist[q, 2], twist[q, 3], twist[q, 4], twist[q, 5]
        for k in range(start[q] + 1):
            own = block[start[q], k]
            for a in range(6):
                t = own[a] * w0 + own[6 + a] * w1 + own[12 + a] * w2
                moved[k, a] = t + own[18 + a] * w3 + own[24 + a] * w4 + own[30 + a] * w5
        for p in range(q + 1):
            t = 0.0
            for a in range(6):
                t += twist[p, a] * moved[start[p], a]
            hessian[q, p] += t
            if p < q:
                hessian[p, q] += t
    return cost


@numba.njit(cache=True, nogil=True, fastmath=True)
def _pair_sums(rotation, origin, pairs, products, blocks, force):
    """Write each pair's block of twists (S, S, 36), add the points' pull to the forces; give the cost's square part."""
    z = np.empty((3, 3, 4, 4))
    half = np.empty((4, 4))
    block = np.empty((6, 6))
    tk = np.zeros((4, 4))
    tl = np.zeros((4, 4))
    tk[3, 3] = tl[3, 3] = 1.0
    cost = 0.0
    for m in range(pairs.shape[0]):
        k, j = pairs[m, 0], pairs[m, 1]
        for a in range(3):
            for b in range(3):
                tk[a, b] = rotation[k, a, b]
                tl[b, a] = rotation[j, a, b]
            tk[a, 3] = origin[k, a]
            tl[3, a] = origin[j, a]
        ab = 0
        for a in range(3):
            for b in range(a, 3):
                _times(tk, products[m, ab], half)
                _times(half, tl, z[a, b])
                if b > a:
                    z[b, a] = z[a, b]
                ab += 1
        twice = 1.0 if k == j else 2.0
        for a in range(3):
            for b in range(3):
                cost += twice * z[a, b, a, b]
        _pair_block(z, block)
        _add_forces(z, k, j, force)
        for a in range(6):
            for b in range(6):
                blocks[k, j, 6 * a + b] = block[a, b]
                blocks[j, k, 6 * b + a] = block[a, b]
    return cost


@numba.njit(cache=True, nogil=True, fastmath=True)
def _times(first, second, out):
    """Write the product of two matrices (4, 4)."""
    for r in range(4):
        f0, f1, f2, f3 = first[r, 0], first[r, 1], first[r, 2], first[r, 3]
        for c in range(4):
            out[r, c] = f0 * second[0, c] + f1 * second[1, c] + f2 * second[2, c] + f3 * second[3, c]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _pair_block(z, block):
    """Write the 6x6 block of two segments' twists from z[a, b, r, c] = sum w Q_ab y_k[r] y_l[c]."""
    for a in range(3):
        for b in range(3):
            block[a, b] = z[a, b, 3, 3]
    for c in range(3):
        c1, c2 = (c + 1) % 3, (c + 2) % 3
        for a in range(3):
            # w x y, component b: -[y]x; for the axis c only b = c1 and c2 move.
            block[a, 3 + c] = z[a, c2, 3, c1] - z[a, c1, 3, c2]
            block[3 + c, a] = z[c2, a, c1, 3] - z[c1, a, c2, 3]
    for c in range(3):
        c1, c2 = (c + 1) % 3, (c + 2) % 3
        for d in range(3):
            d1, d2 = (d + 1) % 3, (d + 2) % 3
            block[3 + c, 3 + d] = (
                z[c2, d2, c1, d1] - z[c2, d1, c1, d2] - z[c1, d2, c2, d1] + z[c1, d1, c2, d2]
            )  # fmt: skip


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_forces(z, k, j, force):
    """Add what the points of the pair pull at each of its two segments."""
    for c in range(3):
        c1, c2 = (c + 1) % 3, (c + 2) % 3
        for b in range(3):
            force[k, c] += z[c, b, 3, b]
            force[k, 3 + c] += z[c2, b, c1, b] - z[c1, b, c2, b]
            if k != j:
                force[j, c] += z[b, c, b, 3]
                force[j, 3 + c] += z[b, c2, b, c1] - z[b, c1, b, c2]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _subtract_target(rotation, origin, linear, force):
    """Subtract the pull of the targets from a segment's force; give the cost's linear part."""
    y = np.empty((3, 4))
    cost = 0.0
    for a in range(3):
        for r in range(3):
            t = linear[a, 3] * origin[r]
            for s in range(3):
                t += linear[a, s] * rotation[r, s]
            y[a, r] = t
        y[a, 3] = linear[a, 3]
        cost -= 2.0 * y[a, a]
    for c in range(3):
        c1, c2 = (c + 1) % 3, (c + 2) % 3
        force[c] -= y[c, 3]
        force[3 + c] -= y[c2, c1] - y[c1, c2]
    return cost
