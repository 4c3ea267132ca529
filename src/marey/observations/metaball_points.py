"""Points measured on a person's surface: each lies on the surface of the metaballs ([Plaenkers1999] section 4.3)."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_person import MetaballSpace
from marey.body.metaballs.metaballs import Metaballs, PosedMetaballs
from marey.observations.observation import Linearization, Observation


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class PointsOnMetaballs(Observation):
    """Measured points lie on the surface of the metaballs ([Plaenkers1999] eq. (13), (14)).

    Unlike the paper, whose residual F - 1/2 has no unit, it is the distance from the surface in units of each point's
    own standard deviation: that of the measurement along the surface's normal and of the model.

    The body's numbers are those of the space, and its skeleton is the space's own.
    """

    space: MetaballSpace
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
        """Count the points."""
        return len(self.points)

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual, in units of each point's own."""
        return 1.0

    def surface(self, posed: PosedBody) -> PosedMetaballs:
        """Give the metaballs of a body in its pose."""
        return PosedMetaballs(self.balls(posed.body.numbers), posed.pose)

    def balls(self, numbers: Floats) -> Metaballs:
        """Give the metaballs for numbers (N,); the same ones as long as the numbers stay."""
        known = self._kept.get("numbers")
        if known is None or not np.array_equal(known, numbers):
            self._kept.update(numbers=np.array(numbers), balls=self.space.balls(numbers))
        return self._kept["balls"]

    @cached_property
    def _kept(self) -> dict:
        return {}

    def linearize(self, posed: PosedBody, *, shape: bool = False) -> Linearization:
        """Give the distances from the surface, in standard deviations; `fit.point_equations` sums them up directly."""
        surface = self.surface(posed)
        of = surface.distances(self.points, self.limb)
        jacobian = surface.by_pose(self.points, of)
        if shape:
            jacobian = np.concatenate([jacobian, self.space.by_numbers(surface, of)], 1)
        return Linearization(of.residual / self.spread, jacobian / self.spread[:, None])


def assign(
    space: MetaballSpace, posed: PosedBody, points: Floats, covariance: Floats, *, model_sd: Floats
) -> PointsOnMetaballs:
    """Segment measured points by the nearest limb ([Plaenkers1999] section 3.3), and say how well each is known.

    Args:
        space: whose numbers the body's are.
        posed: where the body is believed.
        points: (n, 3) in the world [m].
        covariance: (n, 3, 3) of the points [m2].
        model_sd: (n,) how far the person's surface lies from any metaballs', as a standard deviation [m].
    """
    surface = PosedMetaballs(space.balls(posed.body.numbers), posed.pose)
    limb, outward = surface.nearest_limbs(points)
    own = np.einsum("na,nab,nb->n", outward, covariance, outward, optimize=True)
    spread = np.sqrt(np.maximum(own, 0.0) + model_sd**2)
    return PointsOnMetaballs(space=space, points=points, limb=limb, spread=spread)


def thinned(observation: PointsOnMetaballs, which: Integers) -> PointsOnMetaballs:
    """Keep only some of the points."""
    return replace(
        observation, points=observation.points[which], limb=observation.limb[which], spread=observation.spread[which]
    )  # fmt: skip
