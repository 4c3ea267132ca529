"""Correspondence: which point of the posed surface belongs to which point of an outline (section 2.2 of the paper)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.kinematics import points_on_faces
from marey.body.articulation.pose import PosedBody, SurfacePoints
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.rays import PluckerLines
from marey.cameras.visibility import MARGIN, Scratch, View, draw_into, rim_pixels, see
from marey.images.silhouettes.contours import Contour, trace_contour
from marey.images.silhouettes.interior import InteriorEdges
from marey.images.silhouettes.nearest import nearest_other, nearest_within, sort_into_cells
from marey.kernels import kernel
from marey.observations.silhouette import SilhouettePlanes, SilhouetteRays
from marey.observations.votes import SLACK, elect

Residual = Literal["plane", "ray"]


@dataclass(frozen=True, eq=False)
class Sighting:
    """A silhouette that one camera saw, ready to be matched."""

    camera: Camera
    contour: Contour
    interior: InteriorEdges | None = None
    """Edges of limbs inside of the silhouette, where the picture was looked at for them."""

    @staticmethod
    def of(camera: Camera, mask: Mask) -> "Sighting":
        """Trace the silhouette that a camera saw: mask (height, width)."""
        return Sighting(camera, trace_contour(mask))

    @cached_property
    def planes(self) -> tuple[Floats, Floats]:
        """Unit normals (n, 3), towards the inside, and offsets (n,) of the contour's tangent planes."""
        return self.camera.contour_planes(self.contour.pixels, self.contour.inward)

    @cached_property
    def seen(self) -> Mask:
        """(n,) true where the contour's plane is known: the lens shows nothing beyond."""
        return np.isfinite(self.planes[1])

    @cached_property
    def rays(self) -> PluckerLines:
        """The rays (n,) of the contour's pixels."""
        return self.camera.rays(self.contour.pixels)

    @cached_property
    def radians_per_pixel(self) -> Floats:
        """(n,) the angle by which a step of one pixel across the contour turns the ray."""
        return self.camera.ray_turns(self.contour.pixels, self.contour.inward)

    @cached_property
    def interior_planes(self) -> tuple[Floats, Floats, Floats]:
        """Unit normals (n, 3), towards the limb in front, and offsets (n,) of the interior edges' tangent planes.

        The third is what `radians_per_pixel` is to the contour. A surface's rim is made of its outermost pixels, whose
        centres lie half a pixel within the edge itself.
        """
        edges = self.interior or InteriorEdges.none()
        pixels = edges.pixels + 0.5 * edges.inward
        normals, offsets = self.camera.contour_planes(pixels, edges.inward)
        return normals, offsets, self.camera.ray_turns(pixels, edges.inward)


@dataclass(frozen=True, kw_only=True)
class Matching:
    """How far and how differently directed a match may be."""

    gate: float = 25.0
    """Greatest distance between a rim point and its contour pixel [px]."""
    cosine: float = 0.3
    """Least cosine between their normals."""
    sigma_px: float = 3.2
    """Standard deviation of a match across the contour, its neighbours' likeness included [px]."""
    residual: Residual = "plane"
    """Whether rim points are drawn to the contour's tangent planes or, as the paper does, to its pixels' rays."""
    vote: bool = False
    """Whether neighbours decide where a contour pixel could belong to two limbs."""
    interior: bool = False
    """Whether edges inside of the silhouette are matched, too: they were found about the body, and are near it."""
    interior_gate: float = 5.0
    interior_cosine: float = 0.8
    interior_sigma_px: float = 3.2


def view_of(posed: PosedBody, camera: Camera) -> View:
    """Draw the posed surface as a camera sees it."""
    projected = np.empty_like(posed.vertices)
    lens.project_points(camera.packed, posed.vertices, projected)
    return see(projected, posed.body.faces, camera.size)


def match_outline(posed: PosedBody, view: View, sighting: Sighting, matching: Matching) -> SilhouettePlanes | None:
    """Match the rim of the surface to an outline both ways: each rim point and each contour pixel looks for the other.

    Args:
        posed: the body that was drawn.
        view: what the camera sees of it.
        sighting: what the camera saw.
        matching: what counts as a match.

    Returns:
        The matches as observations, or None where there are none.
    """
    found = _matches(posed, view, sighting, matching)
    if found is None:
        return None
    where, j, pixels_per_metre = found
    return as_planes(sighting, where, j, pixels_per_metre, matching)


def as_planes(
    sighting: Sighting, where: SurfacePoints, j: Integers, pixels_per_metre: Floats, matching: Matching
) -> SilhouettePlanes:
    """Fasten surface points to the tangent planes of their contour pixels (n,)."""
    normals, offsets = sighting.planes
    return SilhouettePlanes(
        where=where, normals=normals[j], offsets=offsets[j], pixels_per_metre=pixels_per_metre,
        sigma_px=matching.sigma_px,
    )  # fmt: skip


def as_rays(
    sighting: Sighting, where: SurfacePoints, j: Integers, pixels_per_metre: Floats, matching: Matching
) -> SilhouetteRays:
    """Fasten surface points to the rays of their contour pixels (n,)."""
    rays = sighting.rays
    return SilhouetteRays(
        where=where, directions=rays.directions[j], moments=rays.moments[j], pixels_per_metre=pixels_per_metre,
        sigma_px=matching.sigma_px,
    )  # fmt: skip


class Outline(NamedTuple):
    """Matches of an outline, each listed once."""

    match: SilhouettePlanes | SilhouetteRays
    counts: Floats
    """(n,) two where rim point and contour pixel found each other, else one."""


def see_outline(posed: PosedBody, sighting: Sighting, matching: Matching) -> Outline | None:
    """Draw the posed surface as a camera sees it and match its outline: `view_of` and `match_outline` in one go."""
    body, camera, contour = posed.body, sighting.camera, sighting.contour
    if len(contour.pixels) == 0:
        return None
    face, barycentric, j, scale, counts = draw_and_match(
        Scratch.of(len(posed.vertices), camera.size), posed.vertices, body.faces, body.face_limb, body.outline_counts,
        camera.packed, camera.width, camera.height, camera.centre, contour.cells, contour.inward, sighting.seen,
        sighting.radians_per_pixel, matching.gate, matching.cosine, matching.vote,
    )  # fmt: skip
    if len(j) == 0:
        return None
    fasten = as_rays if matching.residual == "ray" else as_planes
    match = fasten(sighting, SurfacePoints(face=face, barycentric=barycentric), j, scale, matching)
    return Outline(match, counts)


@kernel
def draw_and_match(
    scratch, vertices, faces, limb, outlined, camera, width, height, centre, contour, inward, seen, radians_per_pixel,
    gate, cosine, vote,
):  # fmt: skip
    """Do what `view_of` and `_matches` do without returning to Python in between; pairs found twice are counted."""
    lens.project_points(camera, vertices, scratch.projected)
    left, top, _, face = draw_into(scratch, faces, width, height, MARGIN)
    pixels, rim_inward, rim_face, barycentric, _ = rim_pixels(face, scratch.projected, faces, left, top)
    i = j = np.empty(0, np.int64)
    if len(pixels) > 0:
        i, j = pair_both_ways(
            pixels, rim_inward, limb[rim_face], outlined[rim_face], contour, inward, seen, gate, cosine, vote
        )
    i, j, counts = merge_pairs(i, j, len(pixels))
    on_face, weights = rim_face[i], barycentric[i]
    reach = distances(points_on_faces(vertices, faces, on_face, weights), centre)
    return on_face, weights, j, 1.0 / (radians_per_pixel[j] * reach), counts


@kernel
def merge_pairs(first, second, rims):
    """List each pair once, and count (n,) how often it was found: `pair_both_ways` names a rim pixel's own match first.

    Args:
        first: (k,) rim pixels.
        second: (k,) contour pixels.
        rims: number of rim pixels.
    """
    place = np.full(rims, -1, np.int64)
    kept = np.empty(len(first), np.int64)
    counts = np.ones(len(first))
    count = 0
    for k in range(len(first)):
        i = first[k]
        if place[i] >= 0 and second[kept[place[i]]] == second[k]:
            counts[place[i]] += 1.0
            continue
        if place[i] < 0:
            place[i] = count
        kept[count] = k
        count += 1
    return first[kept[:count]], second[kept[:count]], counts[:count]


def match_rays(posed: PosedBody, view: View, sighting: Sighting, matching: Matching) -> SilhouetteRays | None:
    """Match as `match_outline`, but draw each rim point to its contour pixel's ray, as the paper does."""
    found = _matches(posed, view, sighting, matching)
    if found is None:
        return None
    where, j, pixels_per_metre = found
    return as_rays(sighting, where, j, pixels_per_metre, matching)


def _matches(
    posed: PosedBody, view: View, sighting: Sighting, matching: Matching
) -> tuple[SurfacePoints, Integers, Floats] | None:
    """Give the surface points that were matched, their contour pixels (n,), and the scale (n,) there [px/m]."""
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
    where = SurfacePoints(face=rim.face[i], barycentric=rim.barycentric[i])
    reach = distances(posed.points(where), sighting.camera.centre)
    return where, j, 1.0 / (sighting.radians_per_pixel[j] * reach)


@kernel
def distances(points, centre):
    """Give how far points (n, 3) lie from a centre (3,): (n,)."""
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        out[i] = np.sqrt(x * x + y * y + z * z)
    return out


@kernel
def pair_both_ways(rim, rim_inward, rim_limb, rim_counts, contour, contour_inward, contour_counts, gate, cosine, vote):
    """Pair rim pixels with their nearest contour pixels and contour pixels with their nearest rim pixels.

    Args:
        rim: (n, 2) pixels.
        rim_inward: (n, 2).
        rim_limb: (n,) number of the limb that each belongs to.
        rim_counts: (n,) false where a rim pixel may not be used; it still hides others from the contour.
        contour: the contour's `Cells`.
        contour_inward: (m, 2).
        contour_counts: (m,).
        gate: greatest distance [px].
        cosine: least cosine between the normals.
        vote: whether neighbours vote where a contour pixel could belong to two limbs, see `votes.elect`.

    Returns:
        Indices (k,) of rim pixels and (k,) of contour pixels.
    """
    rim_cells = sort_into_cells(rim)
    size = contour.pixels.shape[0]
    nearest, other = np.full(size, -1, np.int64), np.full(size, -1, np.int64)
    for j in range(size):
        i = nearest_within(rim_cells, contour.pixels[j, 0], contour.pixels[j, 1], gate)
        if i >= 0 and rim_counts[i] and contour_counts[j] and _alike(rim_inward[i], contour_inward[j], cosine):
            nearest[j] = i
            if vote:
                k = nearest_other(rim_cells, rim_limb, i, contour.pixels[j, 0], contour.pixels[j, 1], gate, SLACK)
                if k >= 0 and rim_counts[k] and _alike(rim_inward[k], contour_inward[j], cosine):
                    other[j] = k
    taken, doubtful = elect(nearest, other, rim, rim_limb, contour, contour_inward)
    first, second = np.empty(rim.shape[0] + size, np.int64), np.empty(rim.shape[0] + size, np.int64)
    count = 0
    for i in range(rim.shape[0]):
        j = nearest_within(contour, rim[i, 0], rim[i, 1], gate)
        if j < 0 or not rim_counts[i] or not contour_counts[j] or not _alike(rim_inward[i], contour_inward[j], cosine):
            continue
        if not doubtful[j] or (taken[j] >= 0 and rim_limb[i] == rim_limb[taken[j]]):
            first[count], second[count] = i, j
            count += 1
    for j in range(size):
        if taken[j] >= 0:
            first[count], second[count] = taken[j], j
            count += 1
    return first[:count], second[:count]


@kernel
def _alike(first, second, cosine):
    return first[0] * second[0] + first[1] * second[1] >= cosine
