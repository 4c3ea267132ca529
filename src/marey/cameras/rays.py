"""Rays as Plücker lines."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, freeze_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class PluckerLines:
    """Lines in space: a point x lies on one where x × direction = moment ([Rosenhahn2006] eq. (10))."""

    directions: Floats
    """(..., 3) unit vectors, from the camera into the world."""
    moments: Floats
    """(..., 3) [m], point × direction for any point of the line."""

    def __post_init__(self) -> None:
        freeze_fields(self, "directions", "moments")

    @staticmethod
    def through(point: Floats, directions: Floats) -> "PluckerLines":
        """Return lines through a point, or one line through each of several points.

        Args:
            point: (3,) or (..., 3) [m].
            directions: (..., 3) of any non-zero length.

        Returns:
            The lines.
        """
        unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        return PluckerLines(directions=unit, moments=np.cross(np.broadcast_to(point, unit.shape), unit))

    def __len__(self) -> int:
        return len(self.directions)

    def __getitem__(self, which: int | slice | NDArray[Any]) -> "PluckerLines":
        return PluckerLines(directions=self.directions[which], moments=self.moments[which])

    def distance_vectors(self, points: Floats) -> Floats:
        """Return x × direction - moment for each point: the residual of [Rosenhahn2006] eq. (10).

        Args:
            points: (..., 3) [m], one for each line, or broadcast.

        Returns:
            (..., 3) [m]; its length is the distance of the point from the line, and it is perpendicular to the line and
            to the shortest connection.
        """
        return np.cross(points, self.directions) - self.moments

    def distances(self, points: Floats) -> Floats:
        """Return the distances of points from the lines.

        Args:
            points: (..., 3) [m].

        Returns:
            (...) [m].
        """
        return np.asarray(np.linalg.norm(self.distance_vectors(points), axis=-1))
