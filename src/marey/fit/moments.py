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
from marey.body.pose import PosedBody
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
    segments = len(posed.body.skeleton.segment_names)
    slot = np.full((segments, segments), -1, np.int64)
    products = np.zeros((segments * (segments + 1) // 2, 6, 4, 4))
    linear = np.zeros((segments, 3, 4))
    constant = used = 0
    for i, observation in enumerate(observations):
        rows, offsets = observation.constraints(posed)
        weight = np.ones(len(rows)) if weights is None else weights[i]
        segment, part = posed.parts(observation.where)
        used, more = add_moments(
            np.ascontiguousarray(rows), np.ascontiguousarray(offsets), weight / observation.sigma**2,
            segment, part, slot, used, products, linear,
        )  # fmt: skip
        constant += more
    pairs = np.zeros((used, 2), np.int64)
    k, j = np.nonzero(slot >= 0)
    pairs[slot[k, j]] = np.stack([k, j], 1)
    return Moments(pairs, products[:used], linear, float(constant))


@numba.njit(cache=True, nogil=True, fastmath=True)
def add_moments(rows, offsets, weight, segment, part, slot, used, products, linear):
    """Add observations to the moments; give the number of pairs in use and the sum of w b'b."""
    constant = 0.0
    q = np.empty(6)
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
        for n in range(segment.shape[1]):
            k = segment[i, n]
            if k < 0:
                break
            for c in range(4):
                y = part[i, n, c]
                linear[k, 0, c] += u0 * y
                linear[k, 1, c] += u1 * y
                linear[k, 2, c] += u2 * y
            for m in range(segment.shape[1]):
                j = segment[i, m]
                if j < 0:
                    break
                if j < k:
                    continue
                if slot[k, j] < 0:
                    slot[k, j] = used
                    used += 1
                _add_product(q, part[i, n], part[i, m], products[slot[k, j]])
    return used, constant


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_product(q, first, second, product):
    """Add q[ab] first second' to a pair's products (6, 4, 4); written out so that the compiler makes vectors of it."""
    y0, y1, y2, y3 = second[0], second[1], second[2], second[3]
    for ab in range(6):
        for c in range(4):
            t = q[ab] * first[c]
            product[ab, c, 0] += t * y0
            product[ab, c, 1] += t * y1
            product[ab, c, 2] += t * y2
            product[ab, c, 3] += t * y3


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
def segment_twists(parents, coordinate_segment, origin, world_axes):
    """List for each segment the coordinates that move it, and their twists (v, w) about the world's origin.

    Returns:
        count (S,), column (S, D), twist (S, D, 6).
    """
    segments, coordinates = parents.shape[0], world_axes.shape[0]
    count = np.zeros(segments, np.int64)
    column = np.zeros((segments, 6 + coordinates), np.int64)
    twist = np.zeros((segments, 6 + coordinates, 6))
    for k in range(segments):
        parent = parents[k]
        if parent < 0:
            for a in range(3):
                twist[k, a, a] = 1.0
                twist[k, 3 + a, 3 + a] = 1.0
            # v = origin x w
            x, y, z = origin[k, 0], origin[k, 1], origin[k, 2]
            twist[k, 3, 1], twist[k, 3, 2] = z, -y
            twist[k, 4, 0], twist[k, 4, 2] = -z, x
            twist[k, 5, 0], twist[k, 5, 1] = y, -x
            for a in range(6):
                column[k, a] = a
            n = 6
        else:
            n = count[parent]
            column[k, :n] = column[parent, :n]
            twist[k, :n] = twist[parent, :n]
        for i in range(coordinates):
            if coordinate_segment[i] == k:
                w = world_axes[i]
                column[k, n] = 6 + i
                twist[k, n, 0] = origin[k, 1] * w[2] - origin[k, 2] * w[1]
                twist[k, n, 1] = origin[k, 2] * w[0] - origin[k, 0] * w[2]
                twist[k, n, 2] = origin[k, 0] * w[1] - origin[k, 1] * w[0]
                twist[k, n, 3:] = w
                n += 1
        count[k] = n
    return count, column, twist


@numba.njit(cache=True, nogil=True, fastmath=True)
def assemble(
    parents, coordinate_segment, rotation, origin, world_axes, pairs, products, linear, hessian, gradient
):  # fmt: skip
    """Add the normal equations of all pairs of segments; give the cost without its constant."""
    count, column, twist = segment_twists(parents, coordinate_segment, origin, world_axes)
    segments = parents.shape[0]
    degrees = 6 + world_axes.shape[0]
    z = np.empty((3, 3, 4, 4))
    half = np.empty((4, 4))
    block = np.empty((6, 6))
    moved = np.empty((6, degrees))
    force = np.zeros((segments, 6))
    tk = np.zeros((4, 4))
    tl = np.zeros((4, 4))
    tk[3, 3] = tl[3, 3] = 1.0
    cost = 0.0
    for m in range(pairs.shape[0]):
        k, j = pairs[m, 0], pairs[m, 1]
        for a in range(3):
            for b in range(3):
                tk[a, b] = rotation[k, a, b]
                tl[a, b] = rotation[j, a, b]
            tk[a, 3] = origin[k, a]
            tl[a, 3] = origin[j, a]
        ab = 0
        for a in range(3):
            for b in range(a, 3):
                for r in range(4):
                    for c in range(4):
                        t = 0.0
                        for s in range(4):
                            t += tk[r, s] * products[m, ab, s, c]
                        half[r, c] = t
                for r in range(4):
                    for c in range(4):
                        t = 0.0
                        for s in range(4):
                            t += half[r, s] * tl[c, s]
                        z[a, b, r, c] = t
                        z[b, a, r, c] = t
                ab += 1
        twice = 1.0 if k == j else 2.0
        for a in range(3):
            for b in range(3):
                cost += twice * z[a, b, a, b]
        _pair_block(z, block)
        _add_forces(z, k, j, force)
        for c in range(count[j]):
            for r in range(6):
                t = 0.0
                for s in range(6):
                    t += block[r, s] * twist[j, c, s]
                moved[r, c] = t
        for r in range(count[k]):
            row = column[k, r]
            for c in range(count[j]):
                t = 0.0
                for s in range(6):
                    t += twist[k, r, s] * moved[s, c]
                hessian[row, column[j, c]] += t
                if k != j:
                    hessian[column[j, c], row] += t
    for k in range(segments):
        cost += _subtract_target(rotation[k], origin[k], linear[k], force[k])
        for r in range(count[k]):
            t = 0.0
            for s in range(6):
                t += twist[k, r, s] * force[k, s]
            gradient[column[k, r]] += t
    return cost


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
