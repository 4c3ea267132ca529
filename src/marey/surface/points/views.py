"""Images of one instant prepared for matching, and the choice of the images that are compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.vectors import unit
from marey.images.matching.splines import SplinePicture, spline_of
from marey.images.noise import noise_of
from marey.surface.points.settings import SURFACE_DEFAULTS


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceView:
    """Image of one camera at one instant."""

    camera: Camera
    image: Image
    """(H, W, 3) blue, green, red."""
    mask: Mask | None = None
    """(H, W) true where the surface may be visible; everywhere if None."""

    @cached_property
    def grey(self) -> Image:
        """(H, W)."""
        return np.asarray(cv2.cvtColor(self.image, cv2.COLOR_BGR2GRAY), np.uint8)

    @cached_property
    def spline(self) -> SplinePicture:
        """Spline interpolation of the grey image."""
        return spline_of(self.grey)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of a pixel's noise [grey levels]."""
        return noise_of(self.grey)

    def shows(self, pixels: Floats) -> Mask:
        """Return at which pixels (n, 2) the surface may be visible; false outside the image."""
        inside = self.camera.sees(pixels)
        if self.mask is None:
            return inside
        column, row = np.round(np.where(inside[..., None], pixels, 0.0)).astype(int).T
        return np.asarray(inside & self.mask[row, column])

    def scaled(self, factor: float) -> "SurfaceView":
        """Return the view with a resized image; its mask contains each pixel that shows a part of the whole mask."""
        camera = self.camera.scaled(factor)
        image = cv2.resize(self.image, camera.size, interpolation=cv2.INTER_AREA)
        mask = None
        if self.mask is not None:
            mask = cv2.resize(self.mask.astype(np.float32), camera.size, interpolation=cv2.INTER_AREA) > 0
        return SurfaceView(camera=camera, image=np.asarray(image, np.uint8), mask=mask)


class TemplateSearch(NamedTuple):
    """A template and the images in which its patches are searched, as indices of cameras."""

    template: int
    searched: tuple[int, ...]


def comparisons(
    rig: Rig, *, angle: float, most_searched: int = SURFACE_DEFAULTS.most_searched
) -> tuple[TemplateSearch, ...]:
    """Choose templates so that every camera is used and every template stands between those it is compared with.

    With two cameras the first is the template, with three the middle one ([Plaenkers1999] section 2.1). Ours: with more
    cameras, the camera near most of those not yet assigned becomes the next template; each template is compared with
    its nearest neighbours.

    Args:
        rig: The cameras.
        angle: Largest angle between the viewing directions of compared cameras [rad], unless there are only two.
        most_searched: Largest number of images in which a template is searched.

    Returns:
        The comparisons; none if all cameras are too far apart.
    """
    if len(rig) == 2:
        return (TemplateSearch(0, (1,)),)
    apart = view_angles(rig)
    near = (apart <= angle) & ~np.eye(len(rig), dtype=bool)
    waiting: Mask = np.asarray(near.any(axis=1))
    chosen = []
    while waiting.any():
        searched = [_searched(i, near[i], apart[i], most_searched) for i in range(len(rig))]
        gain = [waiting[i] * 1.0 + waiting[list(others)].sum() for i, others in enumerate(searched)]
        spread = [apart[i, list(others)].sum() if others else np.inf for i, others in enumerate(searched)]
        best = min(range(len(rig)), key=lambda i: (-gain[i], spread[i]))
        chosen.append(TemplateSearch(best, searched[best]))
        waiting[[best, *searched[best]]] = False
    return tuple(chosen)


def _searched(own: int, near: Mask, apart: Floats, most: int) -> tuple[int, ...]:
    others = np.flatnonzero(near)
    return tuple(sorted(map(int, others[np.argsort(apart[others], kind="stable")][:most])))


def view_angles(rig: Rig) -> Floats:
    """Compute the angles (C, C) between the cameras as seen from the centre of the scene [rad].

    The centre is the point nearest to all optical axes; if these are parallel, the angles between the axes are used.
    """
    forward = np.stack([camera.camera_from_world.rotation[2] for camera in rig])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    normal, right = across.sum(axis=0), np.einsum("cij,cj->i", across, rig.centres)
    sight = -forward
    if np.linalg.eigvalsh(normal)[0] > 1e-6 * len(rig):
        away = rig.centres - np.linalg.solve(normal, right)
        if (np.sum(away * sight, axis=1) > 0).all():
            sight = unit(away)
    return np.asarray(np.arccos(np.clip(sight @ sight.T, -1, 1)))


def views_of(rig: Rig, images: Sequence[Image], masks: Sequence[Mask | None] | None = None) -> tuple[SurfaceView, ...]:
    """Combine cameras, images, and masks to views."""
    several = masks if masks is not None else [None] * len(rig)
    return tuple(
        SurfaceView(camera=camera, image=image, mask=mask)
        for camera, image, mask in zip(rig, images, several, strict=True)
    )
