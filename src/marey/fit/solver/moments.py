"""Moments of surface observations, which make the cost of a step independent of the number of points.

A surface point p is the sum over its segments k of T_k y_k. For residuals A p - b the cost is a quadratic
in the segments' motions T for as long as the correspondences are fixed: it is determined by the moments
W = sum w (A'A) x (y_k y_l') and U = sum w (A'b) y_k'. Ours: pairs of segments, so that blended skin is exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody
from marey.compiled.kernel_copies import copy_row
from marey.compiled.kernels import kernel
from marey.lanes import LANES, add_row
from marey.observations.observation import SurfaceObservation


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of all surface observations, from which the normal equations are assembled."""

    pairs: Integers
    """(P, 2) pairs of segments k <= l that share an observation."""
    products: Floats
    """(P, 4, 4, 8) of the pairs: rows of k, columns of l, and the six entries of the symmetric A'A in the order 00 01
    02 11 12 22, followed by two zeros (see `marey.lanes`)."""
    linear: Floats
    """(S, 4, 8) of the segments: rows of y_k, and the three entries of A'b."""
    constant: float
    """Sum of w b'b."""


def gather_moments(
    posed: PosedBody, observations: Sequence[SurfaceObservation], weights: Sequence[Floats] | None = None
) -> Moments:
    """Sum the moments of surface observations.

    Args:
        posed: The body; only its rest shape and the constraints' scales are used, not its pose.
        observations: Surface observations of any kinds.
        weights: For each observation (n,) robust weights of its points; all one if None.
    """
    body = posed.body
    segments = len(body.skeleton.segment_names)
    slot = np.full((segments, segments), -1)
    products = np.zeros(segments * (segments + 1) // 2 * 16 * LANES)
    linear = np.zeros(segments * 4 * LANES)
    constant = used = 0
    for i, observation in enumerate(observations):
        rows, offsets = observation.constraints(posed)
        weight = np.ones(len(rows)) if weights is None else weights[i]
        used, more = add_moments(
            body.faces, body.vertices, body.joint_centres, body.face_shares,
            observation.where.face, observation.where.barycentric, np.ascontiguousarray(rows),
            np.ascontiguousarray(offsets), weight, 1.0 / observation.sigma**2, slot, used, products, linear,
        )  # fmt: skip
        constant += more
    pairs = np.zeros((used, 2), np.int64)
    k, j = np.nonzero(slot >= 0)
    pairs[slot[k, j]] = np.stack([k, j], 1)
    blocks = products[: used * 16 * LANES].reshape(-1, 4, 4, LANES)
    mirror_squares(pairs, blocks)
    return Moments(pairs, blocks, linear.reshape(-1, 4, LANES), float(constant))


@kernel(fastmath=True)
def add_moments(
    faces, vertices, joints, shares, face, barycentric, rows, offsets, weight, precision, slot, used, products, linear
):  # fmt: skip
    """Add observations to the moments; return the number of pairs in use and the sum of w b'b.

    `products` and `linear` are flat; of a segment's own products only the upper triangle is written.
    """
    constant = 0.0
    part = np.empty((shares.segment.shape[1], 4))
    for i in range(rows.shape[0]):
        w = precision * weight[i]
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
        square = (q0, q1, q2, q3, q4, q5, 0.0, 0.0)
        pull = (u0, u1, u2, 0.0, 0.0, 0.0, 0.0, 0.0)
        f = face[i]
        for n in range(shares.number[f]):
            k = shares.segment[f, n]
            y0, y1, y2, y3 = _part(faces, vertices, joints, shares.weight[f, n], f, barycentric, i, k)
            part[n, 0], part[n, 1], part[n, 2], part[n, 3] = y0, y1, y2, y3
            to = k * 4 * LANES
            add_row(linear, to, y0, pull)
            add_row(linear, to + LANES, y1, pull)
            add_row(linear, to + 2 * LANES, y2, pull)
            add_row(linear, to + 3 * LANES, y3, pull)
            for m in range(n):
                j = shares.segment[f, m]
                if slot[j, k] < 0:
                    slot[j, k] = used
                    used += 1
                to = slot[j, k] * 16 * LANES
                for r in range(4):
                    t = part[m, r]
                    add_row(products, to, t * y0, square)
                    add_row(products, to + LANES, t * y1, square)
                    add_row(products, to + 2 * LANES, t * y2, square)
                    add_row(products, to + 3 * LANES, t * y3, square)
                    to += 4 * LANES
            if slot[k, k] < 0:
                slot[k, k] = used
                used += 1
            _add_square(products, slot[k, k] * 16 * LANES, y0, y1, y2, y3, square)
    return used, constant


@kernel(inline="always", fastmath=True)
def _part(faces, vertices, joints, weight, f, barycentric, i, k):
    """Return the part of segment k in point i of face f: its weighted rest position from the joint, and its weight."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    wa, wb, wc = weight[0] * barycentric[i, 0], weight[1] * barycentric[i, 1], weight[2] * barycentric[i, 2]
    w = wa + wb + wc
    x = wa * vertices[a, 0] + wb * vertices[b, 0] + wc * vertices[c, 0] - w * joints[k, 0]
    y = wa * vertices[a, 1] + wb * vertices[b, 1] + wc * vertices[c, 1] - w * joints[k, 1]
    z = wa * vertices[a, 2] + wb * vertices[b, 2] + wc * vertices[c, 2] - w * joints[k, 2]
    return x, y, z, w


@kernel(inline="always", fastmath=True)
def _add_square(products, to, y0, y1, y2, y3, square):
    """Add a part's products with itself: the upper triangle, which `mirror_squares` completes."""
    add_row(products, to, y0 * y0, square)
    add_row(products, to + LANES, y0 * y1, square)
    add_row(products, to + 2 * LANES, y0 * y2, square)
    add_row(products, to + 3 * LANES, y0 * y3, square)
    add_row(products, to + 5 * LANES, y1 * y1, square)
    add_row(products, to + 6 * LANES, y1 * y2, square)
    add_row(products, to + 7 * LANES, y1 * y3, square)
    add_row(products, to + 10 * LANES, y2 * y2, square)
    add_row(products, to + 11 * LANES, y2 * y3, square)
    add_row(products, to + 15 * LANES, y3 * y3, square)


@kernel
def mirror_squares(pairs, products):
    """Complete the products of each segment with itself."""
    for p in range(pairs.shape[0]):
        if pairs[p, 0] == pairs[p, 1]:
            for r in range(1, 4):
                for c in range(r):
                    copy_row(products[p, r, c], products[p, c, r])
