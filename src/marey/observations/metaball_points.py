"""Observations of points on a person's surface, modelled by metaballs ([Plaenkers1999] section 4.3)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_person import MetaballSpace
from marey.body.metaballs.metaballs import Metaballs, PosedMetaballs
from marey.observations.observation import Linearization, Observation


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class PointsOnMetaballs(Observation):
    """Measured points on the surface of the metaballs ([Plaenkers1999] eq. (13), (14)).

    Unlike the paper, whose residual F - 1/2 has no unit, it is the distance from the surface in units of each point's
    own standard deviation, that of the measurement along the surface's normal combined with that of the model.

    The body's numbers are those of the space, and its skeleton is the space's own.
    """

    space: MetaballSpace
    """The metaballs."""
    points: Floats
    """(n, 3) in the world [m]."""
    limb: Integers
    """(n,) index in `LIMBS` of the limb to which each point belongs, see `Metaballs`."""
    spread: Floats
    """(n,) standard deviation of each point's distance from the surface [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "points", "spread")
        freeze_fields(self, "limb", dtype=np.int64)
        if not np.all(self.spread > 0.0):
            raise ValueError("every point needs a standard deviation above zero")

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of each point's own."""
        return 1.0

    def surface(self, posed: PosedBody) -> PosedMetaballs:
        """Return the metaballs of a posed body."""
        return PosedMetaballs(self.balls(posed.body.numbers), posed.pose)

    def balls(self, numbers: Floats) -> Metaballs:
        """Return the metaballs for numbers (N,), cached for the last numbers."""
        known = self._kept.get("numbers")
        if known is None or not np.array_equal(known, numbers):
            self._kept.update(numbers=np.array(numbers), balls=self.space.balls(numbers))
        balls: Metaballs = self._kept["balls"]
        return balls

    @cached_property
    def _kept(self) -> dict[str, Any]:
        return {}

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Return the distances from the surface in standard deviations; `fit.points` sums their equations directly."""
        surface = self.surface(posed)
        of = surface.distances(self.points, self.limb)
        jacobian = surface.by_pose(self.points, of)
        if shape:
            jacobian = np.concatenate([jacobian, self.space.by_numbers(surface, of)], 1)
        return Linearization(of.residual / self.spread, jacobian / self.spread[:, None])


def assign(
    space: MetaballSpace, posed: PosedBody, points: Floats, covariance: Floats, *, model_sd: Floats
) -> PointsOnMetaballs:
    """Assign measured points to the nearest limbs ([Plaenkers1999] section 3.3), with their standard deviations.

    Args:
        space: Metaballs of the body's numbers.
        posed: Body in its current pose.
        points: (n, 3) in the world [m].
        covariance: (n, 3, 3) of the points [m2].
        model_sd: (n,) standard deviation of the person's surface from that of the metaballs [m].
    """
    surface = PosedMetaballs(space.balls(posed.body.numbers), posed.pose)
    limb, outward = surface.nearest_limbs(points)
    own = np.einsum("na,nab,nb->n", outward, covariance, outward, optimize=True)
    spread = np.sqrt(np.maximum(own, 0.0) + model_sd**2)
    return PointsOnMetaballs(space=space, points=points, limb=limb, spread=spread)
