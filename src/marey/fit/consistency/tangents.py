"""How far the silhouettes of two cameras contradict each other: planes through both centres touch both of them.

The outermost planes through the centres of two cameras that touch a body are tangent to its silhouettes in both images
([Sinha2010]). Whatever the body is, the planes that each camera finds are therefore equal, if both cameras show it at
one instant, and both are calibrated.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.cameras.camera import Camera
from marey.cameras.epipolar import EpipolarPlanes
from marey.fit.clocks.signals import BORDER_PX, outermost_planes, outline_pixels

LARGEST_DIFFERENCE_PX = 60.0
"""Differences above this count as this [px]: one silhouette with an error must not outweigh all others. Chosen by
hand."""
LEAST_TANGENTS = 8
"""Pairs of cameras with fewer common tangents are not compared. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The outline of a silhouette, as far as outermost tangents depend on it."""

    pixels: Floats
    """(n, 2) corners of its convex hull, and all of its pixels at the border of the image [px]; none if it is empty."""
    border: Mask
    """(n,) whether the border of the image cuts the silhouette there."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels")
        freeze_fields(self, "border", dtype=np.bool_)

    @staticmethod
    def of(mask: Mask, camera: Camera) -> "Outline":
        """Return the outline of a silhouette (height, width) in the image of a camera."""
        pixels = outline_pixels(mask)
        if not len(pixels):
            return Outline(pixels, np.zeros(0, bool))
        hull = cv2.convexHull(pixels.astype(np.int32))[:, 0].astype(float)
        cut = pixels[~camera.sees(pixels, margin=BORDER_PX)]
        corners = np.concatenate([hull, cut])
        return Outline(corners, ~camera.sees(corners, margin=BORDER_PX))


def planes_between(cameras: Sequence[Camera]) -> dict[tuple[int, int], EpipolarPlanes]:
    """Return the planes through the centres of each pair of cameras that has some."""
    pairs = combinations(range(len(cameras)), 2)
    found = {(i, j): EpipolarPlanes.between(cameras[i], cameras[j]) for i, j in pairs}
    return {pair: planes for pair, planes in found.items() if planes is not None}


@dataclass(frozen=True, eq=False)
class OutlineRays:
    """The rays of the pixels of a camera's outlines, which all pairs with that camera share."""

    directions: Floats
    """(N, 3) unit vectors in the world, outline by outline; NaN where the lens is not invertible."""
    border: Mask
    """(N,) whether the border of the image cuts the silhouette there."""
    counts: Integers
    """(F,) number of pixels of each outline."""
    per_pixel: float
    """Angle by which a ray turns per pixel near the centre of the image [rad/px]."""

    @staticmethod
    def of(camera: Camera, outlines: Sequence[Outline]) -> "OutlineRays":
        """Return the rays of F outlines in the image of a camera."""
        pixels = np.concatenate([np.zeros((0, 2)), *(outline.pixels for outline in outlines)])
        straight = camera.undistort(pixels)
        ahead = np.column_stack([straight, np.ones(len(straight))]) @ camera.camera_from_world.rotation
        return OutlineRays(
            directions=ahead / np.linalg.norm(ahead, axis=1, keepdims=True),
            border=np.concatenate([np.zeros(0, bool), *(outline.border for outline in outlines)]),
            counts=np.array([len(outline.pixels) for outline in outlines], np.int64),
            per_pixel=float(2 / (camera.matrix[0, 0] + camera.matrix[1, 1])),
        )

    def tangents(self, planes: EpipolarPlanes) -> Floats:
        """Return the outermost planes through the centres of this and another camera that touch the outlines.

        Args:
            planes: The planes through both centres.

        Returns:
            (F, 2, 2) for the least and the greatest angle: the angle [rad], and its change per pixel of the outline
            [rad/px]; NaN where the border of the image cuts the silhouette, or there is none.
        """
        found = np.full((len(self.counts), 2, 2), np.nan)
        angle, lever = planes.angles(self.directions)
        known = np.isfinite(angle)
        frames, starts = np.unique(np.repeat(np.arange(len(self.counts)), self.counts)[known], return_index=True)
        if len(frames):
            none = np.zeros(np.count_nonzero(known))
            found[frames] = outermost_planes(
                angle[known], lever[known], self.border[known], none, starts, per_pixel=self.per_pixel
            )[..., :2]
        return found


def differences_px(
    cameras: Sequence[Camera], outlines: Sequence[Sequence[Outline]], only: Iterable[int] | None = None
) -> dict[tuple[int, int], Floats]:
    """Compare the tangent planes of each pair of cameras.

    Args:
        cameras: C cameras.
        outlines: For each camera the outlines of F frames.
        only: Cameras of which each compared pair has at least one; all by default.

    Returns:
        By pair of cameras, the smaller number first: the differences (F, 2) of the planes [px], NaN where one of them
        is not known. Pairs with few common tangents are left out.
    """
    chosen = set(range(len(cameras)) if only is None else only)
    compared = {pair: planes for pair, planes in planes_between(cameras).items() if chosen & set(pair)}
    rays = {c: OutlineRays.of(cameras[c], outlines[c]) for c in {c for pair in compared for c in pair}}
    found = {}
    for (i, j), planes in compared.items():
        first, second = (rays[c].tangents(planes) for c in (i, j))
        turn = np.angle(np.exp(1j * (first[..., 0] - second[..., 0])))
        difference = turn / np.hypot(first[..., 1], second[..., 1])
        if np.count_nonzero(np.isfinite(difference)) >= LEAST_TANGENTS:
            found[i, j] = difference
    return found
