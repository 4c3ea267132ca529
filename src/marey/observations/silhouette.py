"""Outlines: a point of the body's rim lies on the contour that a camera saw."""

from dataclasses import dataclass
from typing import final

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody, SurfacePoints
from marey.observations.observation import SurfaceObservation


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouettePlanes(SurfaceObservation):
    """Rim points lie in the plane through the camera and the contour's tangent.

    Unlike the paper, which draws a point to the ray of one contour pixel ([Rosenhahn2006] eq. (10)),
    the point may slide along the contour, about which a silhouette says nothing; see `SilhouetteRays`.
    """

    where: SurfacePoints
    normals: Floats
    """(n, 3) unit normals of the planes."""
    offsets: Floats
    """(n,) distance of the planes from the world's origin [m]."""
    pixels_per_metre: Floats
    """(n,) how far the point's image moves across the contour."""
    sigma_px: float
    """Standard deviation of the contour across itself [px]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [px]."""
        return self.sigma_px

    def constraints(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Give one row a point: the distance from the plane in pixels."""
        scale = self.pixels_per_metre
        return (self.normals * scale[:, None])[:, None, :], (self.offsets * scale)[:, None]


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class SilhouetteRays(SurfaceObservation):
    """Rim points lie on the ray of a contour pixel ([Rosenhahn2006] eq. (10))."""

    where: SurfacePoints
    directions: Floats
    """(n, 3) unit directions of the Plücker lines."""
    moments: Floats
    """(n, 3) [m]."""
    pixels_per_metre: Floats
    """(n,) scale at the point's depth."""
    sigma_px: float
    """Standard deviation of the contour [px]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [px]."""
        return self.sigma_px

    def constraints(self, posed: PosedBody) -> tuple[Floats, Floats]:
        """Give three rows a point, of rank two: p x n - m, in pixels."""
        rows = self.pixels_per_metre[:, None, None] * _across(self.directions)
        return rows, self.moments * self.pixels_per_metre[:, None]


def _across(directions: Floats) -> Floats:
    """Give the matrices (n, 3, 3) with p x n = -[n]x p."""
    rows = np.zeros((len(directions), 3, 3))
    rows[:, 0, 1], rows[:, 0, 2], rows[:, 1, 2] = directions[:, 2], -directions[:, 1], directions[:, 0]
    rows[:, 1, 0], rows[:, 2, 0], rows[:, 2, 1] = -directions[:, 2], directions[:, 1], -directions[:, 0]
    return rows
