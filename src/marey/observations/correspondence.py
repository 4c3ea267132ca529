"""Correspondence between points of the posed surface and points of an outline ([Rosenhahn2006] section 2.2)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, Mask, frozen
from marey.body.articulation.kinematics import points_on_faces
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.rays import PluckerLines
from marey.cameras.visibility import MARGIN, Scratch, View, draw_into, rim_pixels, see
from marey.compiled.kernels import kernel
from marey.images.silhouettes.contours import SilhouetteContour, trace_contour
from marey.images.silhouettes.interior import InteriorEdges
from marey.images.silhouettes.nearest import Cells, nearest_other, nearest_within, sort_into_cells
from marey.observations.silhouette import SilhouettePlanes, SilhouetteRays
from marey.observations.votes import SLACK, elect_limbs

Residual = Literal["plane", "ray"]
"""Residual of a matched contour pixel: from its tangent plane, or from its ray."""


class PackedLines(NamedTuple):
    """The contour of a silhouette, or the edges inside it, as plain arrays for kernels."""

    cells: Cells
    """The n pixels, sorted into cells."""
    inward: Floats
    """(n, 2) unit normals."""
    limb: Integers
    """(n,) limb to which each edge belongs; zero for a contour."""
    seen: Mask
    """(n,) true where the tangent plane is known."""
    radians_per_pixel: Floats
    """(n,)."""
    normals: Floats
    """(n, 3) of the tangent planes."""
    offsets: Floats
    """(n,) of the tangent planes [m]."""

    @staticmethod
    def of(
        cells: Cells, inward: Floats, limb: Integers, radians: Floats, normals: Floats, offsets: Floats
    ) -> "PackedLines":
        """Pack arrays, all read-only and contiguous, so that kernels are compiled for one kind of them."""
        return PackedLines(
            cells=cells, inward=frozen(inward), limb=frozen(limb, np.int64),
            seen=frozen(np.isfinite(offsets), np.bool_), radians_per_pixel=frozen(radians),
            normals=frozen(normals), offsets=frozen(offsets),
        )  # fmt: skip


class PackedOutline(NamedTuple):
    """A camera, its contour and the edges inside it, as plain arrays for kernels."""

    camera: Floats
    """The packed camera."""
    width: int
    height: int
    centre: Floats
    """(3,) of the camera."""
    contour: PackedLines
    edges: PackedLines


@dataclass(frozen=True, eq=False)
class ObservedOutline:
    """A silhouette in one camera, prepared for matching."""

    camera: Camera
    """The camera."""
    contour: SilhouetteContour
    """Contour of the silhouette."""
    interior: InteriorEdges | None = None
    """Edges of limbs inside the silhouette, if they were extracted."""

    @staticmethod
    def of(camera: Camera, mask: Mask) -> "ObservedOutline":
        """Trace a camera's silhouette, given its mask (height, width)."""
        return ObservedOutline(camera, trace_contour(mask))

    @cached_property
    def planes(self) -> tuple[Floats, Floats]:
        """Unit normals (n, 3), towards the inside, and offsets (n,) of the contour's tangent planes."""
        return self.camera.contour_planes(self.contour.pixels, self.contour.inward)

    @cached_property
    def seen(self) -> Mask:
        """(n,) true where the contour's plane is known; elsewhere the pixel is outside the lens' range."""
        return np.isfinite(self.planes[1])

    @cached_property
    def rays(self) -> PluckerLines:
        """Rays (n,) of the contour's pixels."""
        return self.camera.rays(self.contour.pixels)

    @cached_property
    def radians_per_pixel(self) -> Floats:
        """(n,) angle of the ray per pixel across the contour [rad]."""
        return self.camera.ray_turns(self.contour.pixels, self.contour.inward)

    @cached_property
    def interior_planes(self) -> tuple[Floats, Floats, Floats]:
        """Unit normals (n, 3), towards the limb in front, and offsets (n,) of the interior edges' tangent planes.

        The third array corresponds to `radians_per_pixel` of the contour. A surface's rim consists of its outermost
        pixels, whose centres are half a pixel inside the edge itself.
        """
        edges = self.interior or InteriorEdges.none()
        pixels = edges.pixels + 0.5 * edges.inward
        normals, offsets = self.camera.contour_planes(pixels, edges.inward)
        return normals, offsets, self.camera.ray_turns(pixels, edges.inward)

    @cached_property
    def packed(self) -> PackedOutline:
        """The outline as plain arrays."""
        camera, contour, edges = self.camera, self.contour, self.interior or InteriorEdges.none()
        normals, offsets, radians = self.interior_planes
        none = np.zeros(len(contour.pixels), np.int64)
        return PackedOutline(
            camera=camera.packed, width=camera.width, height=camera.height, centre=camera.centre,
            contour=PackedLines.of(contour.cells, contour.inward, none, self.radians_per_pixel, *self.planes),
            edges=PackedLines.of(edges.cells, edges.inward, edges.limb, radians, normals, offsets),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class OutlineMatchSettings:
    """Limits of distance and direction of a match."""

    gate: float = 25.0
    """Greatest distance between a rim point and its contour pixel [px]."""
    cosine: float = 0.3
    """Least cosine between their normals."""
    sigma_px: float = 3.2
    """Standard deviation of a match across the contour, increased for the correlation of neighbours [px]."""
    residual: Residual = "plane"
    """Whether the residual is the distance from the contour's tangent planes or, as in the paper, from its pixels'
    rays."""
    vote: bool = False
    """Whether neighbours decide to which of two limbs a contour pixel belongs."""
    interior: bool = False
    """Whether edges inside the silhouette are matched. They are extracted near the body."""
    interior_gate: float = 5.0
    """Greatest distance between an interior rim point and its edge pixel [px]."""
    interior_cosine: float = 0.8
    """Least cosine between their normals."""
    interior_sigma_px: float = 3.2
    """Standard deviation of an interior match across the edge [px]."""


def view_of(posed: PosedBody, camera: Camera) -> View:
    """Draw the posed surface in a camera's image."""
    projected = np.empty_like(posed.vertices)
    lens.project_points(camera.packed, posed.vertices, projected)
    return see(projected, posed.body.faces, camera.size)


def as_planes(
    sighting: ObservedOutline,
    where: SkinPoints,
    j: Integers,
    pixels_per_metre: Floats,
    matching: OutlineMatchSettings,
) -> SilhouettePlanes:
    """Return surface points as observations on the tangent planes of their contour pixels (n,)."""
    normals, offsets = sighting.planes
    return SilhouettePlanes(
        where=where, normals=normals[j], offsets=offsets[j], pixels_per_metre=pixels_per_metre,
        sigma_px=matching.sigma_px,
    )  # fmt: skip


def as_rays(
    sighting: ObservedOutline,
    where: SkinPoints,
    j: Integers,
    pixels_per_metre: Floats,
    matching: OutlineMatchSettings,
) -> SilhouetteRays:
    """Return surface points as observations on the rays of their contour pixels (n,)."""
    rays = sighting.rays
    return SilhouetteRays(
        where=where, directions=rays.directions[j], moments=rays.moments[j], pixels_per_metre=pixels_per_metre,
        sigma_px=matching.sigma_px,
    )  # fmt: skip


class OutlineMatches(NamedTuple):
    """Matches of an outline without duplicates."""

    match: SilhouettePlanes | SilhouetteRays
    """The matches as observations."""
    counts: Floats
    """(n,) two where rim point and contour pixel were matched in both directions, else one."""


def outline_matches(
    posed: PosedBody, sighting: ObservedOutline, matching: OutlineMatchSettings
) -> OutlineMatches | None:
    """Draw the posed surface and match the rim with an outline in both directions, in one kernel.

    Args:
        posed: The body to draw.
        sighting: Outline in the camera.
        matching: Limits of a match.

    Returns:
        The matches of rim points with contour pixels and vice versa, or None if there are none.
    """
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
    observations_of = as_rays if matching.residual == "ray" else as_planes
    match = observations_of(sighting, SkinPoints(face=face, barycentric=barycentric), j, scale, matching)
    return OutlineMatches(match, counts)


@kernel
def draw_and_match(
    scratch, vertices, faces, limb, outlined, camera, width, height, centre, contour, inward, seen, radians_per_pixel,
    gate, cosine, vote,
):  # fmt: skip
    """Draw the surface, pair its rim with a contour by `pair_both_ways`, and count the pairs that are found twice."""
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
    """Remove duplicate pairs, and count (n,) how often each was found.

    `pair_both_ways` lists the match of the rim pixel itself first.

    Args:
        first: (k,) rim pixels.
        second: (k,) contour pixels.
        rims: Number of rim pixels.
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


@kernel
def distances(points, centre):
    """Return the distances (n,) of points (n, 3) from a centre (3,)."""
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
        rim_limb: (n,) index of the limb to which each belongs.
        rim_counts: (n,) false where a rim pixel may not be used; it still hides others from the contour.
        contour: The contour's `Cells`.
        contour_inward: (m, 2).
        contour_counts: (m,).
        gate: Greatest distance [px].
        cosine: Least cosine between the normals.
        vote: Whether neighbours vote where a contour pixel could belong to two limbs, see `votes.elect_limbs`.

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
    taken, ambiguous = elect_limbs(nearest, other, rim, rim_limb, contour, contour_inward)
    first, second = np.empty(rim.shape[0] + size, np.int64), np.empty(rim.shape[0] + size, np.int64)
    count = 0
    for i in range(rim.shape[0]):
        j = nearest_within(contour, rim[i, 0], rim[i, 1], gate)
        if j < 0 or not rim_counts[i] or not contour_counts[j] or not _alike(rim_inward[i], contour_inward[j], cosine):
            continue
        if not ambiguous[j] or (taken[j] >= 0 and rim_limb[i] == rim_limb[taken[j]]):
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
