"""Matches of the surface in all cameras, and their moments, with one kernel per camera.

The result is that of `pose_solver.match_cameras` and `moments.gather_moments`, without the matches themselves. Between
two kernels a thread waits for the interpreter's lock; with one kernel in place of ten, two threads gain more.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.kinematics import points_on_faces
from marey.body.articulation.pose import PosedBody
from marey.cameras.visibility import Scratch
from marey.compiled.kernels import kernel
from marey.fit.solver.moments import Moments, add_moments, mirror_squares
from marey.fit.solver.threads import map_in_two_threads
from marey.fit.solver.weights import match_weights
from marey.lanes import LANES
from marey.observations.correspondence import ObservedOutline, OutlineMatchSettings, draw_and_match
from marey.observations.interior import draw_and_match_interior
from marey.observations.observation import residuals


class _Limits(NamedTuple):
    """`OutlineMatchSettings` and the scale of the robust weights, for the kernel."""

    gate: float
    cosine: float
    precision: float
    """Inverse variance of a match [1/px2]."""
    vote: bool
    interior: bool
    interior_gate: float
    interior_cosine: float
    interior_precision: float
    scale: float


class MatchedMoments(NamedTuple):
    """Moments of all matches."""

    moments: Moments
    matches: int
    """Number of matches."""
    weight: float
    """Sum of their weights."""
    square: float
    """Sum of their weighted squared residuals [px2]."""


def gives_moments(matching: OutlineMatchSettings) -> bool:
    """Return whether `match_moments` knows the kind of the residuals."""
    return matching.residual == "plane"


def match_moments(
    posed: PosedBody, sightings: Sequence[ObservedOutline], matching: OutlineMatchSettings, scale: float
) -> MatchedMoments:
    """Match the surface in each camera, and sum the moments of all matches with their robust weights.

    Args:
        posed: The body.
        sightings: One for each camera.
        matching: Limits of a match; the residuals are distances from planes.
        scale: Scale of the robust weights [px].
    """
    body = posed.body
    pairs, slots = body.segment_pairs
    limits = _Limits(
        matching.gate, matching.cosine, 1.0 / matching.sigma_px**2, matching.vote, matching.interior,
        matching.interior_gate, matching.interior_cosine, 1.0 / matching.interior_sigma_px**2, scale,
    )  # fmt: skip
    # A kernel that also adds pairs writes into their numbers.
    known, vertices = slots.copy(), posed.vertices
    # Two sums of half of the cameras each, so that the result does not depend on the number of threads.
    middle = (len(sightings) + 1) // 2
    products = np.zeros((2, len(pairs) * 16 * LANES))
    linear = np.zeros((2, len(body.skeleton.segment_names) * 4 * LANES))

    def of_half(half: int) -> Floats:
        sums = np.zeros(4)
        for sighting in sightings[:middle] if half == 0 else sightings[middle:]:
            packed = sighting.packed
            add_camera(
                Scratch.of(len(vertices), (packed.width, packed.height)), vertices, body.faces, body.face_limb,
                body.outline_counts, body.vertices, body.joint_centres, body.face_shares, packed, limits, known,
                products[half], linear[half], sums,
            )  # fmt: skip
        return sums

    first, second = map_in_two_threads(of_half, range(2))
    blocks, forces = products[0].reshape(-1, 4, 4, LANES), linear[0].reshape(-1, 4, LANES)
    add_sums(pairs, blocks, forces, products[1], linear[1])
    constant, matches, weight, square = map(float, first + second)
    return MatchedMoments(Moments(pairs, blocks, forces, constant), int(matches), weight, square)


@kernel
def add_sums(pairs, products, linear, more_products, more_linear):
    """Add the sums of the second half of the cameras, and complete the products of each segment with itself."""
    all_products, all_linear = products.reshape(-1), linear.reshape(-1)
    for i in range(all_products.size):
        all_products[i] += more_products[i]
    for i in range(all_linear.size):
        all_linear[i] += more_linear[i]
    mirror_squares(pairs, products)


@kernel
def add_camera(
    scratch, vertices, faces, limb, outlined, rest, joints, shares, packed, limits, slots, products, linear, sums
):  # fmt: skip
    """Match a surface in one camera and add the moments of the matches.

    Args:
        scratch: Buffers for the drawing.
        vertices: (V, 3) of the posed surface [m, world].
        faces: (T, 3).
        limb: (T,) limb of each face.
        outlined: (T,) whether the outline of each face is used.
        rest: (V, 3) at rest [m].
        joints: (S, 3) at rest [m].
        shares: `FaceShares`.
        packed: `PackedOutline`.
        limits: `_Limits`.
        slots: (S, S) number of each pair of segments.
        products: Moments of the pairs, flat; added to.
        linear: Moments of the segments, flat; added to.
        sums: (4,) sums of w b'b, of matches, of their weights and of their weighted squares; added to.
    """
    contour, edges = packed.contour, packed.edges
    if len(contour.inward) == 0:
        return
    found = draw_and_match(
        scratch, vertices, faces, limb, outlined, packed.camera, packed.width, packed.height, packed.centre,
        contour.cells, contour.inward, contour.seen, contour.radians_per_pixel, limits.gate, limits.cosine, limits.vote,
    )  # fmt: skip
    _add_lines(
        found, contour, vertices, faces, rest, joints, shares, limits.precision, limits.scale, slots, products, linear,
        sums,
    )  # fmt: skip
    # Without a match the body is not seen in this camera.
    if limits.interior and len(found[2]) > 0 and len(edges.inward) > 0:
        inner = draw_and_match_interior(
            scratch, vertices, faces, outlined, limb, packed.camera, packed.width, packed.height, packed.centre,
            edges.cells, edges.inward, edges.limb, edges.seen, edges.radians_per_pixel, limits.interior_gate,
            limits.interior_cosine, True,
        )  # fmt: skip
        _add_lines(
            inner, edges, vertices, faces, rest, joints, shares, limits.interior_precision, limits.scale, slots,
            products, linear, sums,
        )  # fmt: skip


@kernel
def _add_lines(
    found, lines, vertices, faces, rest, joints, shares, precision, scale, slots, products, linear, sums
):  # fmt: skip
    """Add the moments of the matches with a contour or with edges, see `add_camera`."""
    face, barycentric, j, pixels_per_metre, counts = found
    rows, offsets = np.empty((len(j), 1, 3)), np.empty((len(j), 1))
    for i in range(len(j)):
        offsets[i, 0] = lines.offsets[j[i]] * pixels_per_metre[i]
        for k in range(3):
            rows[i, 0, k] = lines.normals[j[i], k] * pixels_per_metre[i]
    weights = match_weights(rows, offsets, vertices, faces, face, barycentric, counts, scale)
    residual = residuals(rows, offsets, points_on_faces(vertices, faces, face, barycentric))
    _, constant = add_moments(
        faces, rest, joints, shares, face, barycentric, rows, offsets, weights, precision, slots, 0, products, linear
    )
    sums[0] += constant
    sums[1] += len(j)
    for i in range(len(j)):
        sums[2] += weights[i]
        sums[3] += weights[i] * residual[i, 0] ** 2
