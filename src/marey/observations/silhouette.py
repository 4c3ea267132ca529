"""Observations of outlines: points of the body's rim on the contour of a silhouette."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.observations.observation import SurfaceObservation


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouettePlanes(SurfaceObservation):
    """Rim points in the plane through the camera and the contour's tangent.

    Unlike the paper, which moves a point to the ray of one contour pixel ([Rosenhahn2006] eq. (10)), the point is free
    to slide along the contour, where a silhouette gives no information; see `SilhouetteRays`.
    """

    where: SkinPoints
    """The n rim points."""
    normals: Floats
    """(n, 3) unit normals of the planes."""
    offsets: Floats
    """(n,) distance of the planes from the world's origin [m]."""
    pixels_per_metre: Floats
    """(n,) displacement of the point's image across the contour per metre."""
    sigma_px: float
    """Standard deviation of the contour's position across itself [px]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [px]."""
        return self.sigma_px

    def constraints(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return one row per point: the distance from the plane in pixels."""
        return self._in_pixels

    @cached_property
    def _in_pixels(self) -> tuple[Floats, Floats]:
        scale = self.pixels_per_metre
        return (self.normals * scale[:, None])[:, None, :], (self.offsets * scale)[:, None]

    def before_motion(self, motion: Floats) -> "SilhouettePlanes":
        """Return the matches of the same points before they moved by a known motion (n, 3) [m]."""
        return replace(self, offsets=self.offsets - np.sum(self.normals * motion, axis=1))


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteRays(SurfaceObservation):
    """Rim points on the ray of a contour pixel ([Rosenhahn2006] eq. (10))."""

    where: SkinPoints
    """The n rim points."""
    directions: Floats
    """(n, 3) unit directions of the Plücker lines."""
    moments: Floats
    """(n, 3) moments of the Plücker lines [m]."""
    pixels_per_metre: Floats
    """(n,) scale at the point's depth."""
    sigma_px: float
    """Standard deviation of the contour's position [px]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [px]."""
        return self.sigma_px

    def constraints(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return three rows per point, of rank two: p x n - m, in pixels."""
        rows = self.pixels_per_metre[:, None, None] * _across(self.directions)
        return rows, self.moments * self.pixels_per_metre[:, None]

    def before_motion(self, motion: Floats) -> "SilhouetteRays":
        """Return the matches of the same points before they moved by a known motion (n, 3) [m]."""
        return replace(self, moments=self.moments - np.cross(motion, self.directions))


def _across(directions: Floats) -> Floats:
    """Return the matrices (n, 3, 3) with p x n = -[n]x p."""
    rows = np.zeros((len(directions), 3, 3))
    rows[:, 0, 1], rows[:, 0, 2], rows[:, 1, 2] = directions[:, 2], -directions[:, 1], directions[:, 0]
    rows[:, 1, 0], rows[:, 2, 0], rows[:, 2, 1] = -directions[:, 2], directions[:, 1], -directions[:, 0]
    return rows
