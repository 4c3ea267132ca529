"""Matching of limbs in front of another part of the body with the edges inside the silhouettes."""

import numpy as np

from marey.body.articulation.kinematics import points_on_faces
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.cameras import lens
from marey.cameras.visibility import JUMP, MARGIN, Scratch, draw_into, drawn_last, interior_rim_pixels
from marey.compiled.kernels import kernel
from marey.observations.correspondence import (
    ObservedOutline,
    OutlineMatches,
    OutlineMatchSettings,
    distances,
    merge_pairs,
    outline_matches,
    pair_both_ways,
)
from marey.observations.silhouette import SilhouettePlanes


def all_matches(posed: PosedBody, sighting: ObservedOutline, matching: OutlineMatchSettings) -> list[OutlineMatches]:
    """Match the outline and, if enabled, the edges inside it; the surface is drawn once."""
    outline = outline_matches(posed, sighting, matching)
    # Without an outline nothing was drawn; such a silhouette has no edges either.
    inner = None if outline is None else interior_matches(posed, sighting, matching, drawn=True)
    return [found for found in (outline, inner) if found is not None]


def interior_matches(
    posed: PosedBody, sighting: ObservedOutline, matching: OutlineMatchSettings, *, drawn: bool = False
) -> OutlineMatches | None:
    """Draw the posed surface in a camera, and match its interior rims with the edges of the image.

    A rim and an edge match if they are near each other, similar in direction, and of the same limb.

    Args:
        posed: The body.
        sighting: Outline with or without interior edges.
        matching: Limits of a match.
        drawn: Whether this body in this camera is the last one that this thread has drawn.

    Returns:
        The matches, or None if there are none or interior edges are disabled.
    """
    body, camera, edges = posed.body, sighting.camera, sighting.interior
    if not matching.interior or edges is None or len(edges) == 0:
        return None
    normals, offsets, radians_per_pixel = sighting.interior_planes
    face, barycentric, j, scale, counts = draw_and_match_interior(
        Scratch.of(len(posed.vertices), camera.size), posed.vertices, body.faces, body.outline_counts, body.face_limb,
        camera.packed, camera.width, camera.height, camera.centre, edges.cells, edges.inward, edges.limb,
        np.isfinite(offsets), radians_per_pixel,
        matching.interior_gate, matching.interior_cosine, drawn,
    )  # fmt: skip
    if len(j) == 0:
        return None
    match = SilhouettePlanes(
        where=SkinPoints(face=face, barycentric=barycentric), normals=normals[j], offsets=offsets[j],
        pixels_per_metre=scale, sigma_px=matching.interior_sigma_px,
    )  # fmt: skip
    return OutlineMatches(match, counts)


@kernel
def draw_and_match_interior(
    scratch, vertices, faces, outlined, limb, camera, width, height, centre, edges, inward, edge_limb, seen,
    radians_per_pixel, gate, cosine, drawn,
):  # fmt: skip
    """Draw the surface, list its interior rims, and pair them with edges of the same limb; see `draw_and_match`."""
    if not drawn:
        lens.project_points(camera, vertices, scratch.projected)
        draw_into(scratch, faces, width, height, MARGIN)
    left, top, inverse_depth, face = drawn_last(scratch, width, height, MARGIN)
    pixels, rim_inward, rim_face, barycentric, _ = interior_rim_pixels(
        face, inverse_depth, scratch.projected, faces, limb, left, top, JUMP
    )
    i = j = np.empty(0, np.int64)
    if len(pixels) > 0:
        rim_limb = limb[rim_face]
        i, j = pair_both_ways(
            pixels, rim_inward, rim_limb, outlined[rim_face], edges, inward, seen, gate, cosine, False
        )
        same = rim_limb[i] == edge_limb[j]
        i, j = i[same], j[same]
    i, j, counts = merge_pairs(i, j, len(pixels))
    on_face, weights = rim_face[i], barycentric[i]
    reach = distances(points_on_faces(vertices, faces, on_face, weights), centre)
    return on_face, weights, j, 1.0 / (radians_per_pixel[j] * reach), counts
