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

from marey.arrays import Floats, Mask, freeze_fields
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


def tangents_of(camera: Camera, planes: EpipolarPlanes, outlines: Sequence[Outline]) -> Floats:
    """Return the outermost planes that touch the outlines in one camera.

    Args:
        camera: The camera.
        planes: The planes through its centre and that of another one.
        outlines: F outlines in its image.

    Returns:
        (F, 2, 2) for the least and the greatest angle: the angle [rad], and its change per pixel of the outline
        [rad/px]; NaN where the border of the image cuts the silhouette, or there is none.
    """
    per_pixel = float(2 / (camera.matrix[0, 0] + camera.matrix[1, 1]))
    counts = [len(outline.pixels) for outline in outlines]
    found = np.full((len(outlines), 2, 2), np.nan)
    if not sum(counts):
        return found
    angle, lever = planes.angles(camera.rays(np.concatenate([outline.pixels for outline in outlines])).directions)
    known = np.isfinite(angle)
    border = np.concatenate([outline.border for outline in outlines])[known]
    frames, starts = np.unique(np.repeat(np.arange(len(outlines)), counts)[known], return_index=True)
    if len(frames):
        none = np.zeros(len(border))
        found[frames] = outermost_planes(angle[known], lever[known], border, none, starts, per_pixel=per_pixel)[..., :2]
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
    found = {}
    for (i, j), planes in planes_between(cameras).items():
        if not chosen & {i, j}:
            continue
        first, second = (tangents_of(cameras[c], planes, outlines[c]) for c in (i, j))
        turn = np.angle(np.exp(1j * (first[..., 0] - second[..., 0])))
        difference = turn / np.hypot(first[..., 1], second[..., 1])
        if np.count_nonzero(np.isfinite(difference)) >= LEAST_TANGENTS:
            found[i, j] = difference
    return found
