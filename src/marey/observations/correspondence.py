"""Correspondence: which point of the posed surface belongs to which point of an outline (section 2.2 of the paper)."""

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.pose import PosedBody, SurfacePoints
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.visibility import Rim, View, see
from marey.images.contours import Contour, nearest_pixel, trace_contour
from marey.observations.silhouette import SilhouettePlanes, SilhouetteRays


@dataclass(frozen=True, eq=False)
class Sighting:
    """A silhouette that one camera saw, ready to be matched."""

    camera: Camera
    contour: Contour

    @staticmethod
    def of(camera: Camera, mask: Mask) -> "Sighting":
        """Trace the silhouette that a camera saw: mask (height, width)."""
        return Sighting(camera, trace_contour(mask))

    @cached_property
    def planes(self) -> tuple[Floats, Floats]:
        """Unit normals (n, 3), towards the inside, and offsets (n,) of the contour's tangent planes."""
        return self.camera.contour_planes(self.contour.pixels, self.contour.inward)

    @cached_property
    def radians_per_pixel(self) -> Floats:
        """(n,) the angle by which a step of one pixel across the contour turns the ray."""
        half = 0.5 * self.contour.inward
        ahead, behind = (self.camera.rays(self.contour.pixels + s * half).directions for s in (1, -1))
        return np.linalg.norm(ahead - behind, axis=1)


@dataclass(frozen=True, kw_only=True)
class Matching:
    """How far and how differently directed a match may be."""

    gate: float = 25.0
    """Greatest distance between a rim point and its contour pixel [px]."""
    cosine: float = 0.3
    """Least cosine between their normals."""
    sigma_px: float = 3.2
    """Standard deviation of a match across the contour, its neighbours' likeness included [px]."""


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
    rim = view.rim(posed.body.faces)
    contour = sighting.contour
    if len(rim.face) == 0 or len(contour.pixels) == 0:
        return None
    normals, offsets = sighting.planes
    i, j = _pairs(rim, view, contour, matching)
    good = np.isfinite(offsets[j])
    if posed.body.outlined is not None:
        good &= posed.body.outlined[rim.face[i]]
    i, j = i[good], j[good]
    if len(i) == 0:
        return None
    where = SurfacePoints(face=rim.face[i], barycentric=rim.barycentric[i])
    reach = np.linalg.norm(posed.points(where) - sighting.camera.centre, axis=1)
    return SilhouettePlanes(
        where=where, normals=normals[j], offsets=offsets[j],
        pixels_per_metre=1.0 / (sighting.radians_per_pixel[j] * reach), sigma_px=matching.sigma_px,
    )  # fmt: skip


def match_rays(posed: PosedBody, view: View, sighting: Sighting, matching: Matching) -> SilhouetteRays | None:
    """Match as `match_outline`, but draw each rim point to its contour pixel's ray, as the paper does."""
    rim = view.rim(posed.body.faces)
    contour = sighting.contour
    if len(rim.face) == 0 or len(contour.pixels) == 0:
        return None
    i, j = _pairs(rim, view, contour, matching)
    rays = sighting.camera.rays(contour.pixels[j])
    good = np.isfinite(rays.directions[:, 0])
    if posed.body.outlined is not None:
        good &= posed.body.outlined[rim.face[i]]
    if not good.any():
        return None
    i, j = i[good], j[good]
    where = SurfacePoints(face=rim.face[i], barycentric=rim.barycentric[i])
    reach = np.linalg.norm(posed.points(where) - sighting.camera.centre, axis=1)
    return SilhouetteRays(
        where=where, directions=rays.directions[good], moments=rays.moments[good],
        pixels_per_metre=1.0 / (sighting.radians_per_pixel[j] * reach), sigma_px=matching.sigma_px,
    )  # fmt: skip


def _pairs(rim: Rim, view: View, contour: Contour, matching: Matching) -> tuple[Integers, Integers]:
    """List the pairs (rim, contour), from the rim to the contour and back."""
    x, y = (rim.pixels - view.corner).T
    nearest_rim = nearest_pixel(x, y, view.face.shape)
    return pair_both_ways(
        rim.pixels, rim.inward, contour.pixels, contour.inward, contour.nearest, contour.corner[0], contour.corner[1],
        nearest_rim, view.corner[0], view.corner[1], matching.gate, matching.cosine,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def pair_both_ways(
    rim, rim_inward, contour, contour_inward, nearest_contour, contour_left, contour_top,
    nearest_rim, rim_left, rim_top, gate, cosine,
):  # fmt: skip
    """Pair rim pixels with their nearest contour pixels and contour pixels with their nearest rim pixels."""
    first = np.empty(rim.shape[0] + contour.shape[0], np.int64)
    second = np.empty(rim.shape[0] + contour.shape[0], np.int64)
    count = 0
    height, width = nearest_contour.shape
    for i in range(rim.shape[0]):
        x, y = rim[i, 0] - contour_left, rim[i, 1] - contour_top
        if x < 0 or y < 0 or x >= width or y >= height:
            continue
        j = nearest_contour[y, x]
        if _fits(rim[i], rim_inward[i], contour[j], contour_inward[j], gate, cosine):
            first[count] = i
            second[count] = j
            count += 1
    height, width = nearest_rim.shape
    for j in range(contour.shape[0]):
        # Beyond the drawn window the nearest rim pixel is looked up from the window's own border.
        x = min(max(int(contour[j, 0]) - rim_left, 0), width - 1)
        y = min(max(int(contour[j, 1]) - rim_top, 0), height - 1)
        i = nearest_rim[y, x]
        if _fits(rim[i], rim_inward[i], contour[j], contour_inward[j], gate, cosine):
            first[count] = i
            second[count] = j
            count += 1
    return first[:count], second[:count]


@numba.njit(cache=True, nogil=True)
def _fits(rim, rim_inward, contour, contour_inward, gate, cosine):
    dx, dy = rim[0] - contour[0], rim[1] - contour[1]
    along = rim_inward[0] * contour_inward[0] + rim_inward[1] * contour_inward[1]
    return dx * dx + dy * dy <= gate * gate and along >= cosine
