"""Observations of points that are carried by segments, tracked on the surface."""

from dataclasses import dataclass
from typing import final

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import PosedBody
from marey.observations.observation import Linearization, Observation


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class CarriedPoints(Observation):
    """Points attached to segments, at their measured positions ([Plaenkers1999] section 4.2).

    Unlike an untracked surface point, a tracked one also constrains motion along the surface, such as a limb's rotation
    about itself.
    """

    segments: Integers
    """(n,) segment that carries each point."""
    places: Floats
    """(n, 3) position in the segment, from the joint centre about which it turns [m]."""
    points: Floats
    """(n, 3) measured positions in the world [m]."""
    sigma_m: float
    """Standard deviation of a coordinate; skin slides over bones [m]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [m]."""
        return self.sigma_m

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Return the residuals of the points moved with their segments, and their Jacobian."""
        turned = np.einsum("nab,nb->na", posed.segment_rotation[self.segments], self.places)
        part = np.concatenate([self.places, np.ones((len(self.places), 1))], 1)[:, None]
        moved = posed.pose_jacobian(self.segments[:, None], part)
        if shape:
            moved = np.concatenate([moved, posed.origin_shape_jacobian()[self.segments]], 2)
        residual = posed.segment_origin[self.segments] + turned - self.points
        return Linearization(residual.ravel(), moved.reshape(-1, moved.shape[2]))


def local_places(posed: PosedBody, segments: Integers, points: Floats) -> Floats:
    """Return the positions (n, 3), in their segments, of points (n, 3) of the world [m]."""
    away = points - posed.segment_origin[segments]
    return np.asarray(np.einsum("nba,nb->na", posed.segment_rotation[segments], away))
