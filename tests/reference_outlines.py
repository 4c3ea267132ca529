"""Matching of a drawn outline in separate steps: the reference for the kernel of `outline_matches`."""

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.cameras.visibility import View
from marey.observations.correspondence import (
    ObservedOutline,
    OutlineMatchSettings,
    as_planes,
    as_rays,
    distances,
    pair_both_ways,
)
from marey.observations.silhouette import SilhouettePlanes, SilhouetteRays


def match_outline(
    posed: PosedBody, view: View, sighting: ObservedOutline, matching: OutlineMatchSettings
) -> SilhouettePlanes | None:
    """Match the rim of the surface with an outline in both directions: rim points to contour pixels and vice versa.

    Args:
        posed: The drawn body.
        view: Its drawing in the camera.
        sighting: Outline in the camera.
        matching: Limits of a match.

    Returns:
        The matches as observations, or None if there are none.
    """
    found = _matches(posed, view, sighting, matching)
    if found is None:
        return None
    where, j, pixels_per_metre = found
    return as_planes(sighting, where, j, pixels_per_metre, matching)


def match_rays(
    posed: PosedBody, view: View, sighting: ObservedOutline, matching: OutlineMatchSettings
) -> SilhouetteRays | None:
    """Match as `match_outline`, with the distance from the contour pixel's ray as the residual, as in the paper."""
    found = _matches(posed, view, sighting, matching)
    if found is None:
        return None
    where, j, pixels_per_metre = found
    return as_rays(sighting, where, j, pixels_per_metre, matching)


def _matches(
    posed: PosedBody, view: View, sighting: ObservedOutline, matching: OutlineMatchSettings
) -> tuple[SkinPoints, Integers, Floats] | None:
    """Return the matched surface points, their contour pixels (n,), and the scale (n,) there [px/m]."""
    body, contour = posed.body, sighting.contour
    rim = view.rim(body.faces)
    if len(rim.face) == 0 or len(contour.pixels) == 0:
        return None
    i, j = pair_both_ways(
        rim.pixels, rim.inward, body.face_limb[rim.face], body.outline_counts[rim.face], contour.cells, contour.inward,
        sighting.seen, matching.gate, matching.cosine, matching.vote,
    )  # fmt: skip
    if len(i) == 0:
        return None
    where = SkinPoints(face=rim.face[i], barycentric=rim.barycentric[i])
    reach = distances(posed.points(where), sighting.camera.centre)
    return where, j, 1.0 / (sighting.radians_per_pixel[j] * reach)
